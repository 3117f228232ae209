"""Who commands in a chain: the standing controller between jumps, one jump's pilot after the other, and between them
the plan of the next jump, made from what is measured while the robot flies or lands."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from jumplab.errors import InfeasibleError, JumplabError, SolverError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.stance import configuration, stance_angles, stance_configuration
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge, headed, pitch_of
from jumplab.sim.landing import PERIOD_STEPS, LandingController
from jumplab.sim.pilot import AFTER_FALL_S, EXTRA_S, Pilot
from jumplab.sim.playback import Command
from jumplab.sim.result import STAND_S
from jumplab.sim.scene import Scene
from jumplab.stages.planner import USUAL, JumpPlan, Planner
from jumplab.stages.reconstruction import to_link_angles
from jumplab.studies.chain.course import Course, placed, seen_from

FIRST_STAND_S = 0.5  # the first plan, too, is made from a measured posture, once a push of the start is gone
STILL_LEG_RAD, STILL_ARM_RAD = 0.15, 0.25  # still enough to begin: what is left fades within BLEND_S
STILL_RATE, STILL_COM = 1.5, 0.20  # [rad/s] any joint, [m/s]
BLEND_S = 0.25  # a third of the launch, over before the push begins
ROWS, NEWTON = 10, 3  # of the tape per inverse kinematics, and its steps: exact to 1e-6 rad
PATIENCE_S = 3.0  # who is not still this long after touchdown will not be
LARGEST_BIAS = 0.10  # [m, rad] a robot that misses by more than this has another problem than a wrong model
LARGEST_OFFSET_RAD = 0.10  # a posture that is farther off the crouch is not the robot standing still


def _turned(step: np.ndarray) -> np.ndarray:
    """A step (3,) whose turn is within half a turn."""
    return np.array([*step[:2], np.arctan2(np.sin(step[2]), np.cos(step[2]))])


def posture(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Absolute link angles (5,) of ``q`` with the feet taken as flat, mean of left and right [rad]."""
    zero = np.zeros((1, robot.model.nv))
    angles = to_link_angles(robot, q[None], zero, zero)[0][0]
    angles[0] = 0.0
    return angles


@dataclass(frozen=True)
class Rehearsal:
    """Plans of the whole course from the crouch at rest, made before it begins: where re-plans begin."""

    plans: tuple[JumpPlan, ...]  # one per jump; jumps with equal targets share one

    @classmethod
    def of(cls, course: Course, planner: Planner, method: str = USUAL) -> Rehearsal:
        """Plan every jump of the course; raises what the planner raises, with the number of the jump."""
        known: dict = {}
        for k in range(course.count):
            task = course.task(k)
            try:
                known[task] = known[task] if task in known else planner.plan(task, method)
            except (InfeasibleError, SolverError) as e:
                raise InfeasibleError(f"jump {k + 1} of {course.count}: {e}") from e
        return cls(tuple(known[course.task(k)] for k in range(course.count)))


@dataclass
class Ahead:
    """One plan of a chain; times are simulated [s], since the chain began, places from where the toes stood then."""

    number: int  # of the jump, from 0
    looked_s: float  # when the state was measured
    air: bool  # whether the robot was in the air then
    foretold: np.ndarray  # (3,) x, y and heading that the feet had, or were going to have, by that measurement
    place: np.ndarray  # (3,) the same, less what such forecasts were wrong by in this chain
    start: np.ndarray  # (5,) link angles in which the plan begins [rad]
    joints: np.ndarray  # (nv - 6,) the same as joint angles [rad]
    bias: np.ndarray  # (3,) what was added to way and turn because earlier jumps of this chain missed by it
    solve_s: float  # what planning was charged: its wall clock, in whole steps, unless another number was given
    cpu_s: float  # processor time of the same, which an idle core would need
    plan: JumpPlan | None
    failure: str = ""  # why there is no plan
    needed_s: float | None = None  # when the robot was first still enough to begin
    began_s: float | None = None  # when it began the jump

    @property
    def foretold_m(self) -> float:
        """How far ahead the feet were foretold [m]."""
        return float(self.foretold[0])

    @property
    def place_m(self) -> float:
        """The same, corrected [m]."""
        return float(self.place[0])

    @property
    def bias_m(self) -> float:
        """What was added to the distance [m]."""
        return float(self.bias[0])

    @property
    def ready_s(self) -> float:
        """When the plan was there: measured, plus what planning took."""
        return self.looked_s + self.solve_s

    @property
    def spare_s(self) -> float | None:
        """How long before it was needed it was there [s]; negative if late, None if it was never needed."""
        return None if self.needed_s is None else self.needed_s - self.ready_s

    @property
    def in_time(self) -> bool:
        """Whether the plan was there when the robot was ready for it."""
        return self.plan is not None and self.spare_s is not None and self.spare_s >= 0


class Foresight:
    """Plans the next jump of a course from measurements, and remembers what the robot's jumps taught.

    ``solve_s`` is what a plan is charged [s], see :func:`jumplab.studies.chain.run_chain`.
    """

    def __init__(
        self,
        course: Course,
        robot: Robot,
        planner: Planner,
        rehearsal: Rehearsal | None,
        solve_s: float | None = None,
        method: str = "direct",
    ):
        self.course, self.robot, self.planner, self.rehearsal = course, robot, planner, rehearsal
        self._solve_s, self._method, self._offset = solve_s, method, np.zeros(5)
        self._missed: dict[int, np.ndarray] = {}  # jump: by how much way and turn (3,) fell short
        self._misjudged: list[np.ndarray] = []  # by how much poses (3,) foretold in the air were too far
        self._zero: np.ndarray | None = None  # where the chain began, by its own measurement
        self._crouch = stance_angles(robot)

    def learn_posture(self, q: np.ndarray) -> None:
        """Plans begin as far off the crouch as the robot, heavier perhaps, stands still in ``q``."""
        self._offset = np.clip(posture(self.robot, q) - self._crouch, -LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD)

    def learn_place(self, last: Ahead, began: np.ndarray, plans: list[Ahead], pose: np.ndarray) -> None:
        """Jump ``last`` brought the feet from ``began`` in the world to ``pose``, as the next ``plans`` foretold."""
        self._missed[last.number] = self._short(last, began, pose)
        self._misjudged += [_turned(p.foretold - seen_from(self._zero, pose)) for p in plans if p.air]

    def _short(self, last: Ahead, began: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """By how much way and turn (3,) of a jump between two poses fell short of its plan."""
        task = last.plan.task
        return _turned(np.array([task.distance_m, task.side_m, task.yaw_rad]) - seen_from(began, pose))

    @property
    def bias(self) -> np.ndarray:
        """Mean (3,) of what the jumps so far fell short by [m, rad]."""
        return np.clip(np.mean([*self._missed.values()] or [np.zeros(3)], axis=0), -LARGEST_BIAS, LARGEST_BIAS)

    def look(
        self,
        number: int,
        time_s: float,
        pose: np.ndarray,
        air: bool = False,
        last: tuple[Ahead, np.ndarray] | None = None,
    ) -> Ahead:
        """Plan jump ``number`` for feet that have, or in the ``air`` will have, the ``pose`` (3,) in the world.

        It is x and y of the toes, or on a course with sides and turns of the soles' middle [m], and the heading [rad].
        ``last`` is the plan of the jump before, and the pose from where it began.
        """
        began, cpu, plan, failure = time.perf_counter(), time.process_time(), None, ""
        if self._zero is None:
            self._zero = np.array(pose, float)
        foretold = seen_from(self._zero, pose)
        place = foretold - (np.mean(self._misjudged, axis=0) if air and self._misjudged else 0.0)
        if last is not None:
            self._missed[last[0].number] = self._short(last[0], last[1], placed(self._zero, place))
        start, bias = self._crouch + self._offset, self.bias
        try:
            step, asked = seen_from(place, self.course.goals[number]), np.array([0.0, 0.0, self.course.step(number)[2]])
            task = self.course.task(number, _turned(step - asked) + asked + bias)
            if self.rehearsal is None:
                plan = self.planner.plan(task, self._method, start=start)
            else:
                plan = self.planner.replan(self.rehearsal.plans[number], task, start=start)
        except JumplabError as e:
            failure = str(e)
        took, cpu = time.perf_counter() - began, time.process_time() - cpu
        charged = math.ceil((took if self._solve_s is None else self._solve_s) / STEP_S - 1e-9) * STEP_S
        joints = configuration(self.robot, start)[7:]
        return Ahead(number, time_s, air, foretold, place, start, joints, bias, charged, cpu, plan, failure)


class ChainPilot:
    """Commands of a whole chain, as its :class:`Foresight` plans it; ``landing``, ``look_s`` and ``revise_s`` are those
    of :func:`jumplab.studies.chain.run_chain`, ``lead_s`` that of each jump's :class:`jumplab.sim.pilot.Pilot`."""

    def __init__(
        self,
        foresight: Foresight,
        scene: Scene,
        landing: str,
        look_s: float,
        revise_s: float | None,
        lead_s: float = 0.0,
        force_noise_n: float = 0.0,
    ):
        self._force_noise_n = force_noise_n
        self._foresight, self._robot, self._scene = foresight, foresight.robot, scene
        self._landing, self._look_s, self._revise_s, self._lead_s = landing, look_s, revise_s, lead_s
        self._gauge, self._stand = Gauge(self._robot), LandingController(self._robot, force_noise_n=force_noise_n)
        self._tau = np.zeros(len(self._robot.joint_names))
        self._legs = ~np.isin(self._robot.joint_names, self._robot.joints["shoulder_pitch"])
        self.plans: list[list[Ahead]] = []  # made for each jump, in their order
        self.used: list[Ahead] = []  # plan of each jump that began, and its pilot and first step
        self.pilots: list[Pilot] = []
        self.began: list[int] = []
        self.reason = ""  # why the chain goes on no more

    @property
    def part(self) -> int:
        """The part of the log that this is: one per jump; the stand before the first jump belongs to it."""
        return max(len(self.began) - 1, 0)

    @property
    def _further(self) -> bool:
        """Whether the course has a jump after the one that is under way."""
        return len(self.began) < self._foresight.course.count

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
        return bool(self.reason) or (not self._further and self.since_touchdown(step) >= STAND_S + EXTRA_S)

    def command(self, step: int, q: np.ndarray, v: np.ndarray, wrench: np.ndarray) -> Command:
        """Command at ``step`` of the chain from measured state and foot wrenches (2, 6)."""
        if self._further and not self.reason:
            self._think(step, q, v)
        if not self.pilots:
            if step % PERIOD_STEPS == 0:
                self._tau = self._stand.torque(step * STEP_S, q, v, wrench[:, 2])
            return Command(tau=self._tau)
        now, pilot = step - self.began[-1], self.pilots[-1]
        command = pilot.command(now, q, v, wrench)
        if pilot.touchdown is None and now > pilot.last_step:
            self.reason = self.reason or f"jump {len(self.began)} never touched down"
        return command if command.q is None else self._blended(command, (now + pilot.playback.lead) * STEP_S)

    def _think(self, step: int, q: np.ndarray, v: np.ndarray) -> None:
        """Plan the next jump when it is time to, and begin it when plan and robot are ready."""
        number = len(self.began)
        if len(self.plans) == number:
            self.plans.append([])
        plans = self.plans[number]
        if plans and self.landed and self._begun(plans, step, q, v):
            return
        seen = self._sight(step, q, v, plans)
        if seen is not None:
            last = (self.used[-1], self._from) if self.used else None
            plans.append(self._foresight.look(number, step * STEP_S, *seen, last))
        elif plans and self.landed:
            revisable = plans[-1].air and self._revise_s is not None
            if all(p.failure for p in plans) and not revisable:
                self.reason = f"no plan for jump {number + 1}: {plans[-1].failure}"
            elif self.since_touchdown(step) > PATIENCE_S + sum(p.solve_s for p in plans):
                self.reason = f"the robot did not come to rest for jump {number + 1}"

    def _begun(self, plans: list[Ahead], step: int, q: np.ndarray, v: np.ndarray) -> bool:
        """Begin with the latest plan that is there, if the robot is still enough; notes when it was."""
        now, still = step * STEP_S, self._still(plans[0], q, v)
        needed = now if still and plans[0].needed_s is None else plans[0].needed_s
        for plan in plans:
            plan.needed_s = needed
        there = [p for p in plans if p.plan is not None and now >= p.ready_s - STEP_S / 2]
        if still and there:
            self._begin(there[-1], step, q, v)
        return still and bool(there)

    def _pose(self, q: np.ndarray) -> np.ndarray:
        """Pose (3,) of the feet as the course counts it: straight ahead the toes' x alone."""
        if self._foresight.course.in_plane:
            return np.array([self._gauge.toe(q)[0], 0.0, 0.0])
        return np.array([*self._gauge.soles(q)[:2], self._gauge.heading(q)])

    def _sight(self, step: int, q: np.ndarray, v: np.ndarray, plans: list[Ahead]) -> tuple[np.ndarray, bool] | None:
        """Pose (3,) of the feet, now or to come, and whether the robot flies; None unless it is time to plan."""
        if not self.pilots:
            if plans or step * STEP_S < FIRST_STAND_S:
                return None
            self._foresight.learn_posture(q)
            return self._pose(q), False
        since = self.since_touchdown(step)
        if plans:  # one core plans: a correction waits until the draft is done
            due = plans[-1].air and self._revise_s is not None and since >= self._revise_s
            return (self._pose(q), False) if due and step * STEP_S >= plans[-1].ready_s else None
        if since >= max(self._look_s, 0.0):
            return self._pose(q), False
        airborne = (step - self.began[-1]) * STEP_S > self.used[-1].plan.tape.takeoff_time
        if self.landed or self._look_s >= 0 or not airborne:
            return None
        left = self.pilots[-1].forecast.time_left(self.pilots[-1].seen(q), v)
        return None if left > -self._look_s else (self._at_touchdown(step, q, v, left), True)

    def _at_touchdown(self, step: int, q: np.ndarray, v: np.ndarray, left: float) -> np.ndarray:
        """Pose (3,) at the touchdown to come: the posture of the tape, turned as far as the trunk is off its pitch and
        its heading now, on the ballistic CoM."""
        tape, pilot = self.used[-1].plan.tape, self.pilots[-1]
        row = np.searchsorted(tape.t, (step - self.began[-1]) * STEP_S)
        turned, q = pitch_of(q) - pitch_of(tape.q[min(row, len(tape.t) - 1)]), pilot.seen(q)
        end, _ = pilot.forecast.state(q, v, pin.rpy.rpyToMatrix(0.0, float(turned), 0.0))
        end[:3] += self._gauge.com_ahead(q, v, left) - self._gauge.com(end)
        if self._foresight.course.in_plane:
            return self._pose(end)
        off = pilot.heading_error(step - self.began[-1], q)
        return self._pose(headed(end, -pilot.looks_rad)) + np.array([0.0, 0.0, off])

    def _still(self, ahead: Ahead, q: np.ndarray, v: np.ndarray) -> bool:
        """Whether the robot stands in the posture in which the plan begins, within the tolerances."""
        off = np.abs(q[7:] - ahead.joints)
        near = off[self._legs].max() <= STILL_LEG_RAD and off.max() <= STILL_ARM_RAD
        slow = np.abs(v[6:]).max() <= STILL_RATE and np.linalg.norm(self._gauge.com_velocity(q, v)) <= STILL_COM
        return bool(near and slow)

    def _begin(self, ahead: Ahead, step: int, q: np.ndarray, v: np.ndarray) -> None:
        ahead.began_s, pose, tape = step * STEP_S, self._pose(q), ahead.plan.tape
        if self.used:
            self._foresight.learn_place(self.used[-1], self._from, self.plans[-1], pose)
        self._from, self._uneven = pose, _over_feet(tape, self._robot, q)
        self._offset = q[7:] - tape.q[0, 7:] - self._uneven(0.0), v[6:].copy()
        self.used.append(ahead)
        how = dict(lead_s=self._lead_s, start_rad=float(pose[2]), force_noise_n=self._force_noise_n)
        how |= dict(leads_back=False)  # :meth:`_blended` does
        self.pilots.append(Pilot(tape, self._robot, self._scene, "position", self._landing, **how))
        self.began.append(step)

    def _blended(self, command: Command, time: float) -> Command:
        """The tape's command over the feet as they stand, plus what else was left of posture and rates when it began,
        fading smoothly; once they are off the ground, the feet are drawn to their places beside each other."""
        ends, moved = self._uneven.x[-1], np.array([command.q, command.rate, command.acceleration])
        moved += _fading(*self._offset, time)
        if time < ends:
            moved += [self._uneven(time, order) for order in range(3)]
        else:
            moved += _fading(self._uneven(ends), self._uneven(ends, 1), time - ends)
        return replace(command, q=moved[0], rate=moved[1], acceleration=moved[2])


def _fading(error: np.ndarray, rate: np.ndarray, time: float) -> np.ndarray:
    """A cubic from ``error`` and ``rate`` at time 0 to rest at zero: its value, rate and acceleration (3, ...)."""
    if time >= BLEND_S:
        return np.zeros((3, *error.shape))
    s = time / BLEND_S
    angle = (1 + 2 * s) * (1 - s) ** 2 * error + s * (1 - s) ** 2 * BLEND_S * rate
    speed = (6 * s * s - 6 * s) / BLEND_S * error + (1 - s) * (1 - 3 * s) * rate
    push = (12 * s - 6) / BLEND_S**2 * error + (6 * s - 4) / BLEND_S * rate
    return np.array([angle, speed, push])


def _over_feet(tape: Tape, robot: Robot, q: np.ndarray) -> CubicSpline:
    """Joint angles (nv - 6,) over the time of the launch [s] to add to the tape's, so that its trunk moves as planned
    between feet that stand as in ``q`` (nq,) instead of side by side.

    Legs that are made even on feet that are not would twist the robot, and turn it further in every jump.
    """
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in robot.foot.frames]
    legs = [[i for i in model.supports[model.frames[f].parentJoint] if i > 1] for f in frames]
    columns = [[model.idx_vs[i] for i in leg] for leg in legs]
    pin.framesForwardKinematics(model, data, tape.q[0])
    planned = [data.oMf[f].act(robot.foot.center) for f in frames]
    moves = _unevenness(model, data, frames, robot.foot.center, q, planned)
    launch = np.flatnonzero(tape.phase == "launch")
    rows = np.unique(np.append(launch[::ROWS], launch[-1]))
    out = np.zeros((len(rows), model.nv - 6))
    for k, row in enumerate(rows):
        pin.framesForwardKinematics(model, data, tape.q[row])
        goals, now = [move * data.oMf[f] for move, f in zip(moves, frames, strict=True)], tape.q[row].copy()
        for _ in range(NEWTON):
            pin.computeJointJacobians(model, data, now)
            for goal, f, leg in zip(goals, frames, columns, strict=True):
                off = pin.log6(pin.updateFramePlacement(model, data, f).actInv(goal)).vector
                slope = pin.getFrameJacobian(model, data, f, pin.ReferenceFrame.LOCAL)[:, leg]
                now[np.array(leg) + 1] += np.linalg.lstsq(slope, off, rcond=None)[0]
        out[k] = now[7:] - tape.q[row, 7:]
    return CubicSpline(tape.t[rows], out)


def _unevenness(model, data, frames: list[int], center: np.ndarray, q: np.ndarray, planned: list) -> list[pin.SE3]:
    """What moves each foot from its ``planned`` place (sole's middles) to where it stands in ``q``, seen from between
    both: along the ground, and turned about the vertical."""
    pin.framesForwardKinematics(model, data, q)
    soles = [data.oMf[f].act(center) for f in frames]
    ahead = [data.oMf[f].rotation[:2, 0] for f in frames]
    x, y = np.sum(ahead, axis=0)
    own, middle = pin.rpy.rpyToMatrix(0.0, 0.0, -math.atan2(y, x)), np.mean(soles, axis=0)
    out = []
    for sole, (c, s), place in zip(soles, ahead, planned, strict=True):
        off = own @ (sole - middle) - (place - np.mean(planned, axis=0))
        yaw = math.remainder(math.atan2(s, c) - math.atan2(y, x), math.tau)
        turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.zeros(3))
        there = pin.SE3(np.eye(3), place + off * [1.0, 1.0, 0.0])
        out.append(there * turn * pin.SE3(np.eye(3), -place))
    return out
