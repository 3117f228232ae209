"""Who commands in a chain: the standing controller between jumps, and one jump's pilot after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jumplab.robot.stance import stance_configuration
from jumplab.sim import STEP_S
from jumplab.sim.actuation import Command
from jumplab.sim.kinematics import Gauge, pitch_of
from jumplab.sim.landing import PERIOD_STEPS, LandingController
from jumplab.sim.pilot import AFTER_FALL_S, EXTRA_S, Pilot
from jumplab.sim.result import STAND_S
from jumplab.sim.scene import Scene
from jumplab.studies.chain.foresight import Ahead, Foresight

FIRST_STAND_S = 0.5  # the first plan, too, is made from a measured posture, once a push of the start is gone
# still enough to begin: the tape begins at rest, and what is left fades within BLEND_S
STILL_LEG_RAD, STILL_ARM_RAD = 0.15, 0.25
STILL_RATE, STILL_COM = 1.5, 0.20  # [rad/s] any joint, [m/s]
BLEND_S = 0.25  # a third of the launch, over before the push begins
PATIENCE_S = 3.0  # who is not still this long after touchdown will not be


class ChainPilot:
    """Commands of a whole chain, as its :class:`Foresight` plans it; ``landing``, ``look_s`` and ``revise_s`` are those
    of :func:`jumplab.studies.chain.run_chain`.

    Attributes
    ----------
    plans : plans made for each jump, in the order in which they were made.
    used, pilots, began : plan, pilot and first step of each jump that began.
    reason : why the chain goes on no more; empty while it does.
    """

    def __init__(self, foresight: Foresight, scene: Scene, landing: str, look_s: float, revise_s: float | None):
        self._foresight, self._robot, self._scene = foresight, foresight.robot, scene
        self._landing, self._look_s, self._revise_s = landing, look_s, revise_s
        self._gauge, self._stand = Gauge(self._robot), LandingController(self._robot)
        self._tau = np.zeros(len(self._robot.joint_names))
        self._legs = ~np.isin(self._robot.joint_names, self._robot.joints["shoulder_pitch"])
        self.plans: list[list[Ahead]] = []
        self.used: list[Ahead] = []
        self.pilots: list[Pilot] = []
        self.began: list[int] = []
        self.reason = ""

    @property
    def current(self) -> int:
        """Number of the jump that is under way, -1 before the first."""
        return len(self.began) - 1

    @property
    def part(self) -> int:
        """The part of the log that this is: one per jump; the stand before the first jump belongs to it."""
        return max(self.current, 0)

    @property
    def goal(self) -> np.ndarray:
        """Crouch (nq,) on the surface that the present jump shall land on."""
        end = stance_configuration(self._robot)
        end[2] += self._foresight.course.platforms_m[self.part]
        return end

    @property
    def landed(self) -> bool:
        """Whether the robot stands: before the first jump, or after a touchdown."""
        return not self.pilots or self.pilots[-1].touchdown is not None

    def since_touchdown(self, step: int) -> float:
        """Time since the last touchdown, or since the chain began [s]; negative in the air."""
        if not self.pilots:
            return step * STEP_S
        return (step - self.began[-1] - self.pilots[-1].touchdown) * STEP_S if self.landed else -1.0

    def over(self, step: int, fallen_s: float) -> bool:
        """Whether something has ended the chain, or its last landing has been watched."""
        if fallen_s > AFTER_FALL_S:
            self.reason = f"the robot fell in jump {self.part + 1}"
        last = self.current + 1 == self._foresight.course.count
        return bool(self.reason) or (last and self.since_touchdown(step) >= STAND_S + EXTRA_S)

    def command(self, step: int, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> Command:
        """Command at ``step`` of the chain from measured state and vertical foot forces."""
        if self.current + 1 < self._foresight.course.count and not self.reason:
            self._think(step, q, v)
        if not self.pilots:
            if step % PERIOD_STEPS == 0:
                self._tau = self._stand.torque(step * STEP_S, q, v, force)
            return Command(tau=self._tau)
        now, pilot = step - self.began[-1], self.pilots[-1]
        command = pilot.command(now, q, v, force)
        if pilot.touchdown is None and now > pilot.last_step:
            self.reason = self.reason or f"jump {self.current + 1} never touched down"
        return command if command.q is None else self._blended(command, now * STEP_S)

    def _think(self, step: int, q: np.ndarray, v: np.ndarray) -> None:
        """Plan the next jump when it is time to, and begin it when plan and robot are ready."""
        number, time = self.current + 1, step * STEP_S
        if len(self.plans) == number:
            self.plans.append([])
        plans = self.plans[number]
        if plans and self.landed and self._begun(plans, step, q, v):
            return
        seen = self._sight(step, q, v, plans)
        if seen is not None:
            last = (self.used[-1], self._from) if self.used else None
            plans.append(self._foresight.look(number, time, *seen, last))
        elif plans and self.landed:
            revisable = plans[-1].air and self._revise_s is not None
            if all(p.failure for p in plans) and not revisable:
                self.reason = f"no plan for jump {number + 1}: {plans[-1].failure}"
            elif self.since_touchdown(step) > PATIENCE_S + sum(p.solve_s for p in plans):
                self.reason = f"the robot did not come to rest for jump {number + 1}"

    def _begun(self, plans: list[Ahead], step: int, q: np.ndarray, v: np.ndarray) -> bool:
        """Begin with the latest plan that is there, if the robot is still enough; notes when it was."""
        time, still = step * STEP_S, self._still(plans[0], q, v)
        for plan in plans:
            plan.needed_s = plans[0].needed_s
            if still and plan.needed_s is None:
                plan.needed_s = time
        there = [p for p in plans if p.plan is not None and time >= p.ready_s - STEP_S / 2]
        if still and there:
            self._begin(there[-1], step, q, v)
        return still and bool(there)

    def _sight(self, step: int, q: np.ndarray, v: np.ndarray, plans: list[Ahead]) -> tuple[np.ndarray, bool] | None:
        """Where the toes (3,) stand, or will stand, and whether the robot flies; None unless it is time to plan."""
        if not self.pilots:
            if plans or step * STEP_S < FIRST_STAND_S:
                return None
            self._foresight.learn_posture(q)
            return self._gauge.toe(q), False
        since = self.since_touchdown(step)
        if plans:  # one core plans: a correction waits until the draft is done
            due = plans[-1].air and self._revise_s is not None and since >= self._revise_s
            return (self._gauge.toe(q), False) if due and step * STEP_S >= plans[-1].ready_s else None
        if since >= max(self._look_s, 0.0):
            return self._gauge.toe(q), False
        airborne = (step - self.began[-1]) * STEP_S > self.used[-1].plan.tape.takeoff_time
        if self.landed or self._look_s >= 0 or not airborne:
            return None
        left = self.pilots[-1].forecast.time_left(q, v)
        return None if left > -self._look_s else (self._gauge.toe(self._at_touchdown(step, q, v, left)), True)

    def _at_touchdown(self, step: int, q: np.ndarray, v: np.ndarray, left: float) -> np.ndarray:
        """Configuration (nq,) of the touchdown to come: the posture of the tape, turned as far as the trunk is off its
        pitch now, on the ballistic CoM."""
        tape = self.used[-1].plan.tape
        row = np.searchsorted(tape.t, (step - self.began[-1]) * STEP_S)
        turned = pitch_of(q) - pitch_of(tape.q[min(row, len(tape.t) - 1)])
        end, _ = self.pilots[-1].forecast.state(q, v, turned)
        end[:3] += self._gauge.com_ahead(q, v, left) - self._gauge.com(end)
        return end

    def _still(self, ahead: Ahead, q: np.ndarray, v: np.ndarray) -> bool:
        """Whether the robot stands in the posture in which the plan begins, within the tolerances."""
        off = np.abs(q[7:] - ahead.joints)
        near = off[self._legs].max() <= STILL_LEG_RAD and off.max() <= STILL_ARM_RAD
        slow = np.abs(v[6:]).max() <= STILL_RATE and np.linalg.norm(self._gauge.com_velocity(q, v)) <= STILL_COM
        return bool(near and slow)

    def _begin(self, ahead: Ahead, step: int, q: np.ndarray, v: np.ndarray) -> None:
        ahead.began_s, toe, tape = step * STEP_S, self._gauge.toe(q), ahead.plan.tape
        if self.used:
            self._foresight.learn_place(self.used[-1], self._from, self.plans[-1], toe)
        self._from, self._offset = float(toe[0]), (q[7:] - tape.q[0, 7:], v[6:].copy())
        self.used.append(ahead)
        self.pilots.append(Pilot(tape, self._robot, self._scene, "position", self._landing))
        self.began.append(step)

    def _blended(self, command: Command, time: float) -> Command:
        """The tape's command plus what was left of posture and rates when it began, fading smoothly."""
        if time >= BLEND_S:
            return command
        s, (error, rate) = time / BLEND_S, self._offset
        angle = (1 + 2 * s) * (1 - s) ** 2 * error + s * (1 - s) ** 2 * BLEND_S * rate
        speed = (6 * s * s - 6 * s) / BLEND_S * error + (1 - s) * (1 - 3 * s) * rate
        return replace(command, q=command.q + angle, rate=command.rate + speed)
