"""Pilot of a chain: the standing controller between jumps, one jump's controller after the other,
and between them the plan of the next jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PPoly

from jumplab.control import STAND_S, STEP_S
from jumplab.control.body import PERIOD_STEPS
from jumplab.control.controller import Controller, Hardware
from jumplab.control.kinematics import Gauge, Motion, State, about_vertical, headed, yaw_of
from jumplab.control.landing import LandingController
from jumplab.control.servo import Drive
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.contact import on_feet
from jumplab.robot.legs import bring_feet, give_of
from jumplab.robot.stance import configuration
from jumplab.sim.loop import AFTER_FALL_S, EXTRA_S
from jumplab.sim.scene import Scene
from jumplab.studies.chain.foresight import Ahead, Foresight

MODE = "whole-body"  # of the servos
LANDING = "spring"  # landing controller
# when the next jump is planned, before the touchdown that is due: just before the apex of a rise of
# 0.3 m, from where the toes' place is foretold to 2 mm
LOOK_S = 0.3
# after touchdown, when that plan is made again: the impact is over, the feet lie flat and still
REVISE_S = 0.1
# the first plan, too, is made from a measured posture, once a push of the start is gone
FIRST_STAND_S = 0.5
# still enough to begin: what is left fades within BLEND_S
STILL_LEG_RAD = 0.15
STILL_ARM_RAD = 0.25
# [rad/s] any joint, [m/s]
STILL_RATE = 1.5
STILL_COM = 0.20
BLEND_S = 0.25  # a third of the launch, over before the push begins
ROWS = 10  # of the tape per inverse kinematics: exact to 1e-6 rad
PATIENCE_S = 3.0  # who is not still this long after touchdown will not be


@dataclass
class ChainPilot:
    """Torques of a whole chain, as its :class:`Foresight` plans it; ``hardware`` is that of each
    jump's :class:`jumplab.control.Controller`.
    """

    foresight: Foresight
    scene: Scene
    hardware: Hardware = Hardware()

    def __post_init__(self):
        self._course = self.foresight.course
        self._robot = self.foresight.robot
        self._gauge = Gauge(self._robot)
        self._stand = LandingController(self._robot, force_noise_n=self.hardware.force_noise_n)
        self._tau = np.zeros(len(self._robot.joint_names))
        arms = np.isin(self._robot.joint_names, self._robot.joints["shoulder_pitch"])
        self._still_rad = np.where(arms, STILL_ARM_RAD, STILL_LEG_RAD)
        self.plans: list[Ahead] = []  # all that were made, in their order
        self.jumps: list[Ahead] = []  # that have begun
        self.reason = ""  # why the chain goes on no more

    @property
    def _further(self) -> bool:
        """Whether the course has a jump after the one that is under way."""
        return len(self.jumps) < self._course.count

    def since_touchdown(self, step: int) -> float:
        """Time since the last touchdown, or since the chain began [s]; negative in the air."""
        if not self.jumps:
            return step * STEP_S
        landed = self.jumps[-1].controller.touchdown
        return -1.0 if landed is None else (self._now(step) - landed) * STEP_S

    def _now(self, step: int) -> int:
        """Steps since the jump that is under way began."""
        return step - round(self.jumps[-1].began_s / STEP_S)

    def over(self, step: int, fallen_s: float) -> bool:
        """Whether something has ended the chain, or its last landing has been watched; the robot
        has lain on the ground for ``fallen_s`` [s].
        """
        if fallen_s > AFTER_FALL_S:
            self.reason = f"the robot fell in jump {max(len(self.jumps), 1)}"
        watched = self.since_touchdown(step) >= STAND_S + EXTRA_S
        return bool(self.reason) or (not self._further and watched)

    def drive(self, t: float, state: State) -> Drive:
        """Values to send to the joints' drives at ``t`` since the chain began [s], from the
        measured ``state``.
        """
        step = round(t / STEP_S)
        q, v, _ = state
        if self._further and not self.reason:
            self._think(step, q, v)
        if not self.jumps:
            if step % PERIOD_STEPS == 0:
                self._tau = self._stand.torque(t, q, v, state.wrench[:, 2])
            return Drive(self._tau)
        controller = self.jumps[-1].controller
        now = self._now(step)
        sent = controller.drive(now * STEP_S, state)
        if controller.touchdown is None and now > controller.last_step:
            self.reason = self.reason or f"jump {len(self.jumps)} never touched down"
        return sent

    def _think(self, step: int, q: np.ndarray, v: np.ndarray) -> None:
        """Plan the next jump when it is time to, and begin it when plan and robot are ready."""
        number = len(self.jumps)
        plans = [plan for plan in self.plans if plan.number == number]
        since = self.since_touchdown(step)
        if plans and since >= 0 and self._begun(plans, step, q, v):
            return
        seen = self._sight(step, q, v, plans)
        if seen is not None:
            last = self.jumps[-1] if self.jumps else None
            self.plans.append(self.foresight.look(number, step * STEP_S, *seen, last))
        elif plans and since >= 0:
            if all(p.failure for p in plans) and not plans[-1].air:
                self.reason = f"no plan for jump {number + 1}: {plans[-1].failure}"
            elif since > PATIENCE_S + sum(p.solve_s for p in plans):
                self.reason = f"the robot did not come to rest for jump {number + 1}"

    def _begun(self, plans: list[Ahead], step: int, q: np.ndarray, v: np.ndarray) -> bool:
        """Begin with the latest plan that is there, if the robot is still enough; notes when it
        was.
        """
        if not self._still(plans[0], q, v):
            return False
        now = step * STEP_S
        for plan in plans:
            plan.needed_s = now if plans[0].needed_s is None else plans[0].needed_s
        there = [p for p in plans if p.plan is not None and now >= p.ready_s - STEP_S / 2]
        if there:
            self._begin(there[-1], step, q, v)
        return bool(there)

    def _pose(self, q: np.ndarray) -> np.ndarray:
        """Pose (3,) of the feet as the course counts it: straight ahead the toes' x alone."""
        if self._course.in_plane:
            return np.array([self._gauge.toe(q)[0], 0.0, 0.0])
        return np.array([*self._gauge.soles(q)[:2], self._gauge.heading(q)])

    def _sight(
        self, step: int, q: np.ndarray, v: np.ndarray, plans: list[Ahead]
    ) -> tuple[np.ndarray, bool] | None:
        """Pose (3,) of the feet, now or to come, and whether the robot flies; None unless it is
        time to plan.
        """
        if not self.jumps:
            if plans or step * STEP_S < FIRST_STAND_S:
                return None
            self.foresight.learn_posture(q)
            return self._pose(q), False
        since = self.since_touchdown(step)
        if plans:  # one core plans: a correction waits until the draft is done
            due = plans[-1].air and since >= REVISE_S
            return (self._pose(q), False) if due and step * STEP_S >= plans[-1].ready_s else None
        if since >= 0.0:
            return self._pose(q), False
        jump = self.jumps[-1]
        if self._now(step) * STEP_S <= jump.plan.tape.takeoff_time:
            return None
        now = self._gauge.motion(headed(q, jump.controller.looks_rad), v)
        left = jump.controller.forecast.time_left(now)
        return None if left > LOOK_S else (self._at_touchdown(step, now, left), True)

    def _at_touchdown(self, step: int, flight: Motion, left: float) -> np.ndarray:
        """Pose (3,) at the touchdown to come, ``left`` [s] later: the posture of the tape, turned
        as far as the trunk will be off it, on the ballistic CoM.
        """
        controller = self.jumps[-1].controller
        turn = controller.forecast.turn_ahead(self._now(step), flight, left)
        end, _ = controller.forecast.state(flight, turn, left)
        fall = self._gauge.model.gravity.linear * left**2 / 2
        end[:3] += flight.com + flight.velocity * left + fall - self._gauge.com(end)
        if self._course.in_plane:
            return self._pose(end)
        pose = self._pose(headed(end, -controller.looks_rad))
        pose[2] += yaw_of(turn)
        return pose

    def _still(self, ahead: Ahead, q: np.ndarray, v: np.ndarray) -> bool:
        """Whether the robot stands in the posture in which the plan begins, to the tolerances."""
        start = configuration(self._robot, ahead.start)[7:]
        near = np.all(np.abs(q[7:] - start) <= self._still_rad)
        speed = np.linalg.norm(self._gauge.motion(q, v).velocity)
        return bool(near and np.abs(v[6:]).max() <= STILL_RATE and speed <= STILL_COM)

    def _begin(self, ahead: Ahead, step: int, q: np.ndarray, v: np.ndarray) -> None:
        ahead.began_s = step * STEP_S
        ahead.began_at = pose = self._pose(q)
        tape = ahead.plan.tape
        if self.jumps:
            plans = [plan for plan in self.plans if plan.number == ahead.number]
            self.foresight.learn_place(self.jumps[-1], plans, pose)
        end = tape.q[-1]
        heading = float(pose[2]) + self._gauge.heading(end)
        ahead.controller = Controller(
            tape,
            self._robot,
            mode=MODE,
            reaim=True,
            landing=LANDING,
            ground=self.scene.seen_along(heading, self._robot, end).top_at,
            hardware=self.hardware,
            start_rad=float(pose[2]),
            at_rest=False,  # its posture and rates are led back here
        )
        uneven = over_feet(tape, self._robot, q)
        for way in (uneven, fading(q[7:] - tape.q[0, 7:] - uneven(0.0), v[6:])):
            ahead.controller.playback.add(way)
        self.jumps.append(ahead)


def fading(error: np.ndarray, rate: np.ndarray, begin: float = 0.0) -> CubicHermiteSpline:
    """A cubic from ``error`` (n,) [rad] and ``rate`` (n,) [rad/s] at time ``begin`` to rest at zero
    :data:`BLEND_S` later.
    """
    rest = np.zeros_like(error)
    return CubicHermiteSpline([begin, begin + BLEND_S], [error, rest], [rate, rest])


def over_feet(tape: Tape, robot: Robot, q: np.ndarray) -> PPoly:
    """Joint angles (nv - 6,) over the time of the launch [s] to add to the tape's, so that its
    trunk moves as planned between feet that stand as in ``q`` (nq,) instead of side by side; once
    they are off the ground, the feet are drawn to their places beside each other.

    Legs that are made even on feet that are not would twist the robot, and turn it further in every
    jump.
    """
    model = robot.model
    data = model.createData()
    anchors = on_feet(robot, robot.foot.center)
    give = give_of(robot)
    gauge = Gauge(robot)
    # the middle of the tape's soles is at the origin
    pairs = zip(_standing(gauge, q), _standing(gauge, tape.q[0]), strict=True)
    moves = [real * planned.inverse() for real, planned in pairs]
    launch = np.flatnonzero(tape.phase == "launch")
    rows = np.unique(np.append(launch[::ROWS], launch[-1]))
    angles = []
    for row in rows:
        pin.forwardKinematics(model, data, tape.q[row])
        goals = {
            anchor: move * anchor.place(data) for anchor, move in zip(anchors, moves, strict=True)
        }
        moved, _ = bring_feet(model, data, tape.q[row], goals, give)
        angles.append(moved[7:] - tape.q[row, 7:])
    spline = CubicSpline(tape.t[rows], angles)
    end = spline.x[-1]
    after = fading(spline(end), spline(end, 1), end)
    spline.extend(after.c, after.x[1:])
    return spline


def _standing(gauge: Gauge, q: np.ndarray) -> list[pin.SE3]:
    """Places of the feet along the ground in ``q`` (nq,), and their turns about the vertical, seen
    from between both.
    """
    feet = gauge.places(headed(q, gauge.heading(q)))
    soles = np.array([foot.act(gauge.robot.foot.center) for foot in feet]) * [1.0, 1.0, 0.0]
    places = []
    for foot, sole in zip(feet, soles - soles.mean(axis=0), strict=True):
        yaw = np.arctan2(foot.rotation[1, 0], foot.rotation[0, 0])
        places.append(pin.SE3(about_vertical(yaw), sole))
    return places
