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
OWN_ARMS, NAIVE_ARMS = 0.25, 0.75  # shares of the arms' swing in stage 3's guess: stage 2's arms swing too far
STEPS_S = (0.015, 0.0125, 0.02)  # stage 2's steps on flat feet, on the toes, in flight [s]: fine enough for a start
SHORTER = (0.9, 0.7, 0.5)  # of the distance; tried after a refusal, half a second each
OTHERWISE = "stage 3 began from postures of a flip instead"  # in words, where stage 2 cannot follow


class Planner:
    """All stages for one robot, built on first use and kept for further targets; ``mesh`` is that of stage 3.

    ``keep`` keeps the built problems for later processes, see :mod:`jumplab.ocp.cache`.
    """

    def __init__(self, robot: Robot, mesh: Mesh = Mesh(), *, keep: bool = False):
        require_type(robot, Robot, "the robot to plan for")
        self.robot, self.mesh, self.keep = robot, mesh, keep
        self._stages: dict[str, Any] = {}

    def stage(self, name: str) -> Any:
        """A stage's planner: "reach", "srmp", "whole body" or "direct"; the last three also as "... flip"."""
        if name not in self._stages:
            build = {
                "reach": lambda: reach(self.robot),
                "srmp": lambda: SrmpPlanner(self.robot, keep=self.keep),
                "srmp flip": lambda: SrmpPlanner(self.robot, SrmpSettings().of_flip(), keep=self.keep),
                "whole body": lambda: WholeBodyPlanner(self.robot, self.mesh, keep=self.keep),
                "whole body flip": lambda: FlipPlanner(self.robot),
                "direct": lambda: WholeBodyPlanner(self.robot, self.mesh, tracking=False, keep=self.keep),
                "direct flip": lambda: FlipPlanner(self.robot, tracking=False),
            }
            self._stages[name] = build[name]()
        return self._stages[name]

    def plan(
        self,
        task: JumpTask,
        method: str = "three-step",
        *,
        weights: Mapping[str, float] | None = None,
        start: np.ndarray | None = None,
    ) -> JumpPlan:
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
        if start is not None and task.rotation_rad:
            raise InputError("a flip begins in the stance; leave its start away, or ask for no rotation")
        where = {} if start is None else {"start": start}
        if method == "direct":
            check_reachable(task, self.stage("reach"), self.robot)
            planner = self.stage("direct flip" if task.rotation_rad else "direct")
            return self._finished(method, planner.plan(task, weights=weights, **where))
        if task.rotation_rad:
            return self._flip(task)
        srmp, joints = self._first_two(task, start)
        last = self.stage("whole body")
        guess = guess_from_joints(joints, last, task, srmp.toe_s)
        body = last.plan(task, srmp, guess=guess, weights=weights, **where)
        return self._finished(method, body, srmp, joints, (_joint_row(joints),))

    def _finished(
        self,
        method: str,
        body: WholeBodyPlan,
        srmp: SrmpPlan | None = None,
        joints: JointPlan | None = None,
        rows: tuple[StageRow, ...] = (),
        skipped: str | None = None,
    ) -> JumpPlan:
        """The plan with its tape and the table of stages; ``rows`` are stage 2's."""
        if srmp is not None:
            rows = (_row("1 SRMP", srmp.solution.statistics), *rows)
        rows = (*rows, *body_rows("direct" if srmp is None else "3 whole body", body))
        tape = make_tape(body, self.robot, srmp)
        return JumpPlan(body.task, self.robot, method, tape, srmp, joints, body, rows, skipped)

    def _flip(self, task: JumpTask) -> JumpPlan:
        """Three steps of a flip. Stage 2 may lose it: rates of 20 rad/s in every link are no feedback's business, and
        its reference says nothing of the tuck. Stage 3 then starts from postures of a flip, and the plan says so.
        """
        first, last = self.stage("srmp flip"), self.stage("whole body flip")
        srmp, joints, body, skipped, rows = first.plan(task), None, None, None, ()
        try:
            joints = map_to_joints(srmp, self.robot.under_gravity(task.gravity), method="direct")
            rows = (_joint_row(joints),)
        except SolverError as e:
            skipped = f"{e}; {OTHERWISE}"
        if joints is not None:
            try:
                body = last.plan(task, srmp, guess=guess_from_joints(joints, last, task, srmp.toe_s))
            except SolverError as e:
                skipped, joints = f"stage 2: its motion led nowhere ({e}); {OTHERWISE}", None
        body = body or last.plan(task, srmp, stage1=first.plan)
        return self._finished("three-step", body, srmp, joints, rows, skipped)

    def _first_two(self, task: JumpTask, start: np.ndarray | None) -> tuple[SrmpPlan, JointPlan]:
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
        srmp, robot = self._pendulum(task, start), self.robot.under_gravity(task.gravity)
        try:
            return srmp, map_to_joints(srmp, robot, STEPS_S, "direct", q0=q0)
        except SolverError:  # at its limits a jump needs more of them
            return srmp, map_to_joints(srmp, robot, method="direct", q0=q0)

    def _pendulum(self, task: JumpTask, start: np.ndarray | None, **near: SrmpPlan) -> SrmpPlan:
        """Stage 1, from the rod of a posture in which the robot waits."""
        return self.stage("srmp").plan(task, start=None if start is None else rod_of(self.robot, start), **near)

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
        srmp, last = None, "direct"
        if previous.method == "direct":
            check_reachable(task, self.stage("reach"), self.robot)
        else:
            srmp, last = self._pendulum(task, start, near=previous.srmp), "whole body"
        body = self.stage(last).plan(task, srmp, near=previous.whole_body, start=start)
        return self._finished(previous.method, body, srmp)


def _row(stage: str, s: Statistics) -> StageRow:
    return StageRow(stage, s.iterations, s.build_s, s.solve_s)


def _joint_row(joints: JointPlan) -> StageRow:
    s = joints.statistics
    return StageRow("2 joint map", s.iterations, s.total_s - s.solve_s, s.solve_s)


def body_rows(stage: str, body: WholeBodyPlan) -> tuple[StageRow, ...]:
    """What stage 3 or the direct planner cost: the coarse mesh, if there was one, and the fine one, each time."""
    coarse = () if body.coarse is None else (_row(f"{stage}, coarse", body.coarse),)
    uneven = (_row(f"{stage}, uneven", statistics) for statistics in body.uneven)
    return (*coarse, *uneven, _row(stage, body.solution.statistics))


def plan_jump(task: JumpTask, robot: Robot, *, method: str = "three-step") -> JumpPlan:
    """Plan one jump from scratch; see :meth:`Planner.plan`. Keep a :class:`Planner` to plan several."""
    return Planner(robot, keep=True).plan(task, method)


def guess_from_joints(
    joints: JointPlan, planner: WholeBodyPlanner, task: JumpTask, toe_s: float
) -> dict[str, PhaseGuess]:
    """Stage 2's roll-out as stage 3's initial guess: left and right are averaged into link angles.

    The arms swing mostly as in :meth:`WholeBodyPlanner.naive_guess`, see :data:`OWN_ARMS`. ``toe_s`` is the length of
    the toe phase [s].
    """
    motion, row = to_link_angles(planner.robot, joints.q, joints.v, joints.a), int(np.argmax(joints.phase == "flight"))
    takeoff, naive, out = float(joints.t[row]), planner.naive_guess(task), {}
    now, names = (x[row : row + 1] for x in motion), ("com", "com_velocity")
    at_takeoff = planar_quantities(planner.robot, *now, np.zeros((1, 2)), task.gravity, names)
    ballistic = dict(zip(("com_x", "com_z", "vel_x", "vel_z"), np.ravel([at_takeoff[k] for k in names]), strict=True))
    for name, t in planner.mesh.nodes(takeoff - toe_s, takeoff, joints.t[-1]).items():
        q, v, a = (np.stack([np.interp(t, joints.t, x) for x in y.T], -1) for y in motion)
        if name == "flat":
            q, v, a = q[:, 1:], v[:, 1:], a[:, 1:]
        if name == "toe":
            q[:, 0] = np.maximum(q[:, 0], 0.0)
        body = PhaseGuess(t[-1] - t[0], q, v, a, None, ballistic if name == "flight" else {})
        out[name] = _with_arms(body, naive[name])
    return out


def _with_arms(body: PhaseGuess, arms: PhaseGuess) -> PhaseGuess:
    """One phase of a guess, its last link swinging partly as in another guess, in its own time."""
    pace, joined = arms.duration / body.duration, []
    for k, (x, y) in enumerate(((body.q, arms.q), (body.v, arms.v), (body.a, arms.a))):
        arm = OWN_ARMS * x[:, -1] + NAIVE_ARMS * (y[:, -1] * pace**k)
        joined.append(np.column_stack([x[:, :-1], arm]))
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
    state = (motion[k] for k in ("angles", "rates", "accels", "toe_acceleration"))
    values = planar_quantities(robot, *state, gravity)
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
