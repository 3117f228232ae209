"""From a target to a finished plan: the paper's three steps in order (or the direct planner), then the 1 kHz tape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, SolverError, quoted, require_type
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import PhaseGuess, Statistics
from jumplab.robot import Robot
from jumplab.robot.reach import reach, rod_of
from jumplab.robot.stance import configuration
from jumplab.stages.joint_qp import JointPlan, map_to_joints
from jumplab.stages.plan import JumpPlan, StageRow
from jumplab.stages.reconstruction import expand, planar_motion, planar_quantities
from jumplab.stages.srmp import SrmpPlan, SrmpPlanner
from jumplab.stages.srmp.reachable import check_reachable
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.whole_body import FlipPlanner, Mesh, WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.planner import check_platform
from jumplab.task import JumpTask

METHODS = ("three-step", "direct")
# Our choice: shares of the arms' swing in stage 3's guess. Stage 2's arms swing two to three times as far as stage 3's,
# whichever way inertia and L ask for: from half of their swing alone, 13 of 24 targets ended in one that costs up
# to 44 % more. From this mixture one of 41 does (7 %), after 11 iterations on the fine mesh
OWN_ARMS, NAIVE_ARMS = 0.25, 0.75
# our choice: stage 2's steps on flat feet, on the toes, in flight [s]. Its motion is only stage 3's start here, and it
# keeps all of stage 2's gates over 24 targets (toe drift 0.79 mm of 1, inertia within 2.8 % of 3) in two thirds of the
# time that 10 ms take; with 20 ms on flat feet inertia misses its gate, with 20 ms on the toes they drift by 1.7 mm
STEPS_S = (0.015, 0.0125, 0.02)
SHORTER = (0.9, 0.7, 0.5)  # our choice: of the distance; tried after a refusal, half a second each
OTHERWISE = "stage 3 began from postures of a flip instead"  # in words, where stage 2 cannot follow


class Planner:
    """All stages for one robot, built on first use and kept for further targets; ``mesh`` is that of stage 3.

    ``keep`` keeps the built problems for later processes, see :mod:`jumplab.ocp.cache`.
    """

    def __init__(self, robot: Robot, mesh: Mesh = Mesh(), *, keep: bool = False):
        require_type(robot, Robot, "the robot to plan for")
        self.robot, self.mesh, self.keep = robot, mesh, keep
        self._stages: dict = {}

    def stage(self, name: str) -> Any:
        """A stage's planner: "reach", "srmp", "whole body" or "direct"."""
        if name not in self._stages:
            build = {
                "reach": lambda: reach(self.robot),
                "srmp": lambda: SrmpPlanner(self.robot, keep=self.keep),
                "srmp flip": lambda: SrmpPlanner(self.robot, SrmpSettings().of_flip(), keep=self.keep),
                "whole body": lambda: WholeBodyPlanner(self.robot, self.mesh, keep=self.keep),
                "direct": lambda: WholeBodyPlanner(self.robot, self.mesh, tracking=False, keep=self.keep),
                "whole body flip": lambda: FlipPlanner(self.robot),
                "direct flip": lambda: FlipPlanner(self.robot, tracking=False),
            }
            self._stages[name] = build[name]()
        return self._stages[name]

    def plan(
        self, task: JumpTask, method: str = "three-step", *, weights: Mapping[str, float] | None = None,
        start: np.ndarray | None = None,
    ) -> JumpPlan:  # fmt: skip
        """Plan one jump.

        Parameters
        ----------
        task : the target.
        method : "three-step" (SRMP, joint-space QPs, whole body) or "direct" (the whole body alone, cold).
        weights : of stage 3's cost terms, instead of their own; name -> weight.
        start : absolute link angles (5,) of the posture in which the robot waits at rest, soles flat; the stance if
            None. Not for flips.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            If a stage refuses or fails; no later stage is run.
        """
        require_type(task, JumpTask, "the target")
        if not isinstance(method, str) or method not in METHODS:
            raise InputError(f"method {quoted(method)}: choose one of {', '.join(METHODS)}")
        check_platform(task, self.robot)
        where = _from(start, task)
        if method == "direct":
            check_reachable(task, self.stage("reach"), self.robot)
            planner = self.stage("direct flip" if task.rotation_rad else "direct")
            body = planner.plan(task, weights=weights, **where)
            rows = body_rows("direct", body)
            return JumpPlan(task, self.robot, method, make_tape(body, self.robot), None, None, body, rows)
        if task.rotation_rad:
            return self._flip(task)
        srmp, joints = self._first_two(task, start)
        last = self.stage("whole body")
        body = last.plan(task, srmp, guess=guess_from_joints(joints, last, task, srmp.toe_s), weights=weights,
                         **where)  # fmt: skip
        rows = (_row("1 SRMP", srmp.solution.statistics), _joint_row(joints), *body_rows("3 whole body", body))
        return JumpPlan(task, self.robot, method, make_tape(body, self.robot, srmp), srmp, joints, body, rows)

    def _flip(self, task: JumpTask) -> JumpPlan:
        """Three steps of a flip. Stage 2 may lose it: rates of 20 rad/s in every link are no feedback's business, and
        its reference says nothing of the tuck. Stage 3 then starts from postures of a flip, and the plan says so.
        """
        srmp, joints, skipped = self.stage("srmp flip").plan(task), None, None
        last = self.stage("whole body flip")
        rows = [_row("1 SRMP", srmp.solution.statistics)]
        try:
            joints = map_to_joints(srmp, self.robot.under_gravity(task.gravity), method="direct")
            rows.append(_joint_row(joints))
        except SolverError as e:
            skipped = f"{e}; {OTHERWISE}"
        body, climb = None, self.stage("srmp flip").plan
        if joints is not None:
            try:
                body = last.plan(task, srmp, guess=guess_from_joints(joints, last, task, srmp.toe_s))
            except SolverError as e:
                skipped, joints = f"stage 2: its motion led nowhere ({e}); {OTHERWISE}", None
        body = body or last.plan(task, srmp, stage1=climb)
        rows = (*rows, *body_rows("3 whole body", body))
        return JumpPlan(task, self.robot, "three-step", make_tape(body, self.robot, srmp), srmp, joints, body, rows,
                        skipped)  # fmt: skip

    def _first_two(self, task: JumpTask, start=None) -> tuple[SrmpPlan, JointPlan]:
        """Stages 1 and 2; where stage 2 refuses, the nearest of a few shorter jumps that passes both is named."""
        try:
            return self._pass(task, start)
        except SolverError as e:
            nearest = self._nearest(task) if e.stage == "joint_map" else ""  # stage 1 looks for one itself
            if not nearest:
                raise
            raise SolverError(f"{e}{nearest}", stage=e.stage, status=e.status, violations=e.violations) from e

    def _pass(self, task: JumpTask, start: np.ndarray | None = None) -> tuple[SrmpPlan, JointPlan]:
        q0 = None if start is None else configuration(self.robot, start, toe=-self.robot.sagittal.sole_center)
        srmp = self.stage("srmp").plan(task, start=self._rod(start))
        robot = self.robot.under_gravity(task.gravity)
        try:
            return srmp, map_to_joints(srmp, robot, STEPS_S, "direct", q0=q0)
        except SolverError:  # at its limits a jump needs more of them: 2 of 143
            return srmp, map_to_joints(srmp, robot, method="direct", q0=q0)

    def _rod(self, start: np.ndarray | None) -> np.ndarray | None:
        return None if start is None else rod_of(self.robot, start)

    def _nearest(self, task: JumpTask) -> str:
        """Words about a shorter jump that passes stages 1 and 2; none if stage 1 fails again, which takes its time."""
        for share in SHORTER if task.distance_m else ():
            less = replace(task, distance_m=round(share * task.distance_m, 2))
            try:
                self._pass(less)
            except InfeasibleError:
                continue
            except SolverError as e:
                if e.stage != "joint_map":
                    break
            else:
                return f"; at this height, stages 1 and 2 manage {less.distance_m:g} m"
        return ""

    def replan(self, previous: JumpPlan, task: JumpTask, *, start: np.ndarray | None = None) -> JumpPlan:
        """Plan a target close to one that has a plan of this robot, by the same method and beginning with that plan.

        Stages 1 and 3 begin with their previous solutions. Stage 2, whose result is only a start for stage 3, is left
        out: the previous whole body is the better one. Where a previous solution leads nowhere, the stage starts anew.
        ``start`` as in :meth:`plan`.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            As :meth:`plan`.
        """
        if previous.robot.hash != self.robot.hash:
            raise InputError(f"the previous plan is for the robot {previous.robot.name}, not for {self.robot.name}")
        check_platform(task, self.robot)
        if previous.method == "direct":
            check_reachable(task, self.stage("reach"), self.robot)
            body, srmp, rows = self.stage("direct").plan(task, near=previous.whole_body, start=start), None, ()
        else:
            srmp = self.stage("srmp").plan(task, near=previous.srmp, start=self._rod(start))
            body = self.stage("whole body").plan(task, srmp, near=previous.whole_body, start=start)
            rows = (_row("1 SRMP", srmp.solution.statistics),)
        rows = (*rows, *body_rows("direct" if srmp is None else "3 whole body", body))
        tape = make_tape(body, self.robot, srmp)
        return JumpPlan(task, self.robot, previous.method, tape, srmp, None, body, rows)


def _from(start: np.ndarray | None, task: JumpTask) -> dict[str, np.ndarray]:
    """The argument ``start`` of stage 3, which has none for flips."""
    if start is not None and task.rotation_rad:
        raise InputError("a flip begins in the stance; leave its start away, or ask for no rotation")
    return {} if start is None else {"start": start}


def _row(stage: str, s: Statistics) -> StageRow:
    return StageRow(stage, s.iterations, s.build_s, s.solve_s)


def body_rows(stage: str, body: WholeBodyPlan) -> tuple[StageRow, ...]:
    """What stage 3 or the direct planner cost: the coarse mesh, if there was one, and the fine one, each time."""
    coarse = () if body.coarse is None else (_row(f"{stage}, coarse", body.coarse),)
    uneven = (_row(f"{stage}, uneven", statistics) for statistics in body.uneven)
    return (*coarse, *uneven, _row(stage, body.solution.statistics))


def _joint_row(joints: JointPlan) -> StageRow:
    s = joints.statistics
    return StageRow("2 joint map", s.iterations, s.total_s - s.solve_s, s.solve_s)


def plan_jump(task: JumpTask, robot: Robot, *, method: str = "three-step") -> JumpPlan:
    """Plan one jump from scratch; see :meth:`Planner.plan`. Keep a :class:`Planner` to plan several."""
    return Planner(robot, keep=True).plan(task, method)


def guess_from_joints(
    joints: JointPlan, planner: WholeBodyPlanner, task: JumpTask, toe_s: float
) -> Mapping[str, PhaseGuess]:
    """Stage 2's roll-out as stage 3's initial guess: left and right are averaged into link angles.

    The arms swing mostly as in :meth:`WholeBodyPlanner.naive_guess`, see :data:`OWN_ARMS`.
    """
    robot = planner.robot
    angles, rates, accels = to_link_angles(robot, joints.q, joints.v, joints.a)
    takeoff = int(np.argmax(joints.phase == "flight"))
    rel = planar_quantities(robot, *(x[takeoff : takeoff + 1] for x in (angles, rates, accels)), np.zeros((1, 2)),
                            task.gravity, ("com", "com_velocity"))  # fmt: skip
    guess = planner.guess_from_motion(joints.t, angles, rates, accels, float(joints.t[takeoff]), toe_s, rel["com"],
                                      rel["com_velocity"])  # fmt: skip
    naive = planner.naive_guess(task)
    return {name: _with_arms(body, naive[name]) for name, body in guess.items()}


def _with_arms(body: PhaseGuess, arms: PhaseGuess) -> PhaseGuess:
    """One phase of a guess, its last link swinging partly as in another guess, in its own time."""
    pace, joined = arms.duration / body.duration, []
    for k, (x, y) in enumerate(((body.q, arms.q), (body.v, arms.v), (body.a, arms.a))):
        other = 0.0 if y is None else y[:, -1] * pace**k
        joined.append(np.column_stack([x[:, :-1], OWN_ARMS * x[:, -1] + NAIVE_ARMS * other]))
    return replace(body, q=joined[0], v=joined[1], a=joined[2])


def to_link_angles(
    robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Absolute link angles (n, 5) with rates and accelerations from full-robot q, v, a; the mean of left and right."""
    model, sagittal = robot.model, robot.sagittal
    parts = [[(model.getJointId(n), sign) for n, row, sign in robot.role_signs() if row == i] for i in range(4)]
    iq = [[(model.idx_qs[j], sign) for j, sign in part] for part in parts]
    iv = [[(model.idx_vs[j], sign) for j, sign in part] for part in parts]
    pitch = np.unwrap(2 * np.arctan2(q[:, 4], q[:, 6]), period=2 * np.pi)
    out = []
    for values, index, trunk in ((q, iq, pitch), (v, iv, v[:, 4]), (a, iv, a[:, 4])):
        joints = np.zeros((len(values), 4))  # arms that are held stay at zero
        for i, pair in enumerate(index):
            if pair:
                joints[:, i] = np.mean([sign * values[:, column] for column, sign in pair], axis=0)
        out.append(sagittal.link_angles(joints, trunk))
    return tuple(out)


def make_tape(body: WholeBodyPlan, robot: Robot, srmp: SrmpPlan | None = None) -> Tape:
    """The 1 kHz tape of a whole-body plan, with planar and stage-1 trajectories under their own names."""
    gravity = body.task.gravity
    motion = planar_motion(body.solution.phases, gravity, robot)
    values = planar_quantities(robot, motion["angles"], motion["rates"], motion["accels"], motion["toe_acceleration"],
                               gravity)  # fmt: skip
    extra = {
        "planar_com": motion["toe"] + values["com"],
        "planar_com_velocity": motion["toe_velocity"] + values["com_velocity"],
    }
    extra |= {f"planar_{k}": values[k] for k in ("L", "rho", "rho_rate", "joints", "joint_rates", "torques")}
    if srmp is not None:
        for name in ("launch", "flight"):
            part = getattr(srmp, name)
            extra |= {f"srmp_{name}_{k}": np.array(v) for k, v in vars(part).items()}
    return expand(motion, robot, gravity, extra, values["ground_wrench"])
