"""From a target to a finished plan: the paper's three steps in order (or the direct planner), then the 1 kHz tape."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np

from jumplab.errors import InfeasibleError, InputError, SolverError, quoted, require_type
from jumplab.io.tape import Tape
from jumplab.models.full import FullBody
from jumplab.ocp import Statistics, Term
from jumplab.ocp.nlp import EXPLAINED
from jumplab.robot import Robot
from jumplab.robot.reach import rod_of
from jumplab.robot.stance import configuration, stance_configuration
from jumplab.stages.changes import LAST, StageChanges, settled, sorted_out
from jumplab.stages.joint_qp import JointPlan, Options, map_to_joints
from jumplab.stages.joint_qp.changes import changed, terms_table
from jumplab.stages.plan import JumpPlan, StageRow
from jumplab.stages.reconstruction import planar_columns
from jumplab.stages.srmp import SrmpPlan, SrmpPlanner
from jumplab.stages.srmp.planner import reach_of
from jumplab.stages.srmp.reachable import check_reachable
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.whole_body import Contacts, Limits, Mesh, Weights, WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.planner import GIVEN
from jumplab.stages.whole_body.starts import Motion
from jumplab.stages.whole_body.terms import Body
from jumplab.task import GRAVITY, JumpTask

METHODS, USUAL = ("three-step", "direct"), "usual"
FIRST_STAGES = "srmp", "joint qp"  # those that the direct method leaves out ...
FOLLOWING = "track "  # ... as it does the terms by which stage 3 follows them
STEPS_S = (0.015, 0.0125, 0.02)  # stage 2's steps on flat feet, on the toes, in flight [s]: fine enough for a start
LEAST_RISE_M = 0.02  # that a target can say
ANY = JumpTask(0.5, 0.3)  # a jump straight ahead: its terms are those of all of them
_COUNT = count()
OTHERWISE = "stage 3 began from postures of a flip instead"  # in words, where stage 2 cannot follow


class Planner:
    """All stages for one robot, built on first use and kept for further targets.

    Whatever is changed here holds in every solve of every path: coarse and fine mesh, re-solves, re-plans, flips, the
    direct planner, chains. What would be ignored is refused.

    Parameters
    ----------
    robot : who jumps.
    terms : own costs and constraints: "stage/phase" -> list of :class:`jumplab.Term`. Stages "srmp" and "whole body"
        have phases flat, toe, launch (both) and flight, "joint qp" has launch and flight; "srmp" or "whole body" alone
        takes those at "problem". An expression sees a point with joints, joint_rates, torques, com, com_velocity, L,
        inertia, wrench, posture, point("left_hand"), time, see :class:`jumplab.stages.whole_body.view.BodyView`, and
        in stage 1 com, com_velocity, L, inertia, wrench, lean, posture, time, see
        :class:`jumplab.stages.srmp.view.RodView`. The direct planner takes those of "whole body".
    weights : "stage/term" or "stage/phase/term" -> weight instead of the term's own; without a stage, stage 3's. For
        "joint qp" it is a factor on the block's own weights.
    off : names of the same sort: terms and bounds to leave out.
    limits : of stage 3: :class:`jumplab.stages.whole_body.Limits`, or a mapping of some of its fields.
    settings : of stage 1: :class:`jumplab.stages.srmp.SrmpSettings`, or a mapping of some of its fields.
    mesh : of stage 3: :class:`jumplab.stages.whole_body.Mesh`, or a mapping of some of its fields.
    keep : keep the built problems for later processes, see :mod:`jumplab.ocp.cache`.
    atlas : of plans with the same robot, terms and limits: a :class:`jumplab.Atlas`. Direct plans begin with it where
        it has something close by; other methods refuse it.

    Flips have other limits, settings, weights and a finer mesh; whatever is given here wins over those too.

    Raises
    ------
    InputError
        In one sentence, with the names that exist, for whatever does not fit; terms are looked at when their stage is
        built, before anything is solved.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        terms: Mapping[str, Iterable[Term]] | None = None,
        weights: Mapping[str, float] | None = None,
        off: Iterable[str] = (),
        limits: Limits | Mapping[str, Any] | None = None,
        settings: SrmpSettings | Mapping[str, Any] | None = None,
        mesh: Mesh | Mapping[str, int] | None = None,
        keep: bool = False,
        atlas: Any | None = None,
    ):
        require_type(robot, Robot, "the robot to plan for")
        self.robot, self.keep, self.changes, self.atlas = robot, keep, sorted_out(terms, weights, off), atlas
        self._given = limits, settings, mesh
        self.limits, self.mesh = settled(Limits, limits), self._mesh()
        settled(SrmpSettings, settings)  # refuses what does not fit
        self._stages: dict[str, Any] = {}
        self.token = os.getpid(), next(_COUNT)  # the same in copies that other processes get

    def __getstate__(self) -> dict[str, Any]:
        kept = {k: v for k, v in vars(self).items() if k != "_model"}
        return {**kept, "_stages": {}}  # another process builds its own

    def _mesh(self, flip: bool = False) -> Mesh:
        given = self._given[2]
        return given if isinstance(given, Mesh) else settled(Mesh, given, flip)

    def stage(self, name: str, *, flip: bool = False) -> Any:
        """A stage's planner, of jumps or of flips: "reach", "srmp", "direct", "whole body" (which follows stage 1)."""
        if (name, flip) not in self._stages:
            self._stages[name, flip] = self._built(name, flip)
        return self._stages[name, flip]

    def program(self, task: JumpTask = ANY, weights: Mapping[str, float] = MappingProxyType({})) -> WholeBodyPlanner:
        """The planner of the whole-body program that plans a target directly; ``weights`` as in :meth:`plan`."""
        return self.stage("direct", flip=bool(task.rotation_rad)).program(task, weights)

    def _built(self, name: str, flip: bool) -> Any:
        if name == "reach":
            return reach_of(self.robot, keep=self.keep)
        if name == "srmp":
            settings = settled(SrmpSettings, self._given[1], flip)
            return SrmpPlanner(self.robot, settings, keep=self.keep, changes=self.changes["srmp"])
        weights = Weights().of_flip() if flip else Weights()
        how = {"keep": self.keep, "body": self._model, "changes": self.changes[LAST], "tracking": name == LAST}
        return WholeBodyPlanner(self.robot, self._mesh(flip), settled(Limits, self._given[0], flip), weights, **how)

    @cached_property
    def _model(self) -> Body:
        """The robot as all whole-body programs see it."""
        return Body(self.robot)

    def prepared(
        self, method: str = USUAL, weights: Mapping[str, float] | None = None, task: JumpTask = ANY
    ) -> dict[str, StageChanges]:
        """Build the stages that a method needs for a target, so that nothing is refused after the first has solved.

        Returns the ``weights`` of one plan by stage. Raises :class:`InputError` for own terms, weights or settings that
        the method has no place for, and for names that do not exist.
        """
        asked, flip = sorted_out(weights=weights), bool(task.rotation_rad)
        if self.chosen(method, weights) == "direct":
            ignored = [f"{s!r}" for s in FIRST_STAGES if self.changes[s] or asked[s]]
            if ignored := ignored + ["the settings of 'srmp'"] * (self._given[1] is not None):
                raise InputError(
                    f"the method 'direct' has no place for {' and '.join(ignored)}: it takes limits, mesh and the "
                    f"terms of 'whole body'; choose 'three-step', or leave that out"
                )
            asked[LAST].applied(self.program(task, asked[LAST].weights).nlp.problem)
            return asked
        for name in ("srmp", LAST):
            asked[name].applied(self.stage(name, flip=flip).nlp.problem)
        self._joint_options(asked["joint qp"].weights)
        return asked

    def chosen(self, method: str = USUAL, weights: Mapping[str, float] | None = None) -> str:
        """The method that is meant: "usual" is "direct", but "three-step" where something is changed that only it has.

        Raises :class:`InputError` for a method that does not exist, and for one that this planner cannot follow.
        """
        if not isinstance(method, str) or method not in (USUAL, *METHODS):
            raise InputError(f"method {quoted(method)}: choose one of {', '.join(METHODS)}")
        asked = sorted_out(weights=weights)
        first = any(self.changes[stage] or asked[stage] for stage in FIRST_STAGES) or self._given[1] is not None
        names = (n for x in (self.changes[LAST], asked[LAST]) for n in (*x.weights, *x.off))
        first = first or any(n.rpartition("/")[2].startswith(FOLLOWING) for n in names)
        if method == USUAL:
            method = METHODS[0 if first else 1]
        if self.atlas is not None and method != "direct":
            raise InputError(f"method {quoted(method)}: an atlas holds direct plans; choose 'direct', or leave it away")
        if not self.robot.planar and method != "direct":
            raise InputError(f"method {quoted(method)}: no plane describes robot {self.robot.name}; choose 'direct'")
        return method

    def _less(self, asked: Mapping[str, StageChanges]) -> Planner:
        """This planner; where one plan gives an own term the weight 0, one that has these weights and not that term.

        In the problem it would still move the last digits.
        """
        own = {(stage, t.name) for stage, c in self.changes.items() for terms in c.terms.values() for t in terms}
        now = {stage: dict(c.weights) for stage, c in asked.items()}
        if not own & {(stage, n.rpartition("/")[2]) for stage in now for n, w in now[stage].items() if w == 0}:
            return self
        if (key := repr(now)) not in self._stages:
            less = self._stages[key] = copy(self)
            less._stages, less.changes = {}, {}
            for stage, c in self.changes.items():
                before = {n: w for n, w in c.weights.items() if n not in now[stage]}
                less.changes[stage] = replace(c, weights=before | now[stage])
        return self._stages[key]

    def _joint_options(self, weights: Mapping[str, float] = MappingProxyType({})) -> Options:
        """Stage 2's options with what is changed about it; refuses what does not fit."""
        own = self.changes["joint qp"]
        if not (own or weights):
            return Options()
        body, stance = FullBody(self.robot), stance_configuration(self.robot)
        return changed(Options(), body, stance, own.terms, {**own.weights, **weights}, own.off)

    def terms(self, task: JumpTask = ANY, *, method: str = USUAL) -> list[dict[str, Any]]:
        """All terms and bounds of the stages for a target, own ones included; ``jl.plots.table`` shows them.

        Returns
        -------
        rows with stage, phase, name, kind, at, unit, equation and value (weight, or bounds).
        """
        flip = bool(task.rotation_rad)
        if self.chosen(method) == "direct":
            return self.program(task).nlp.problem.table()
        first, last = (self.stage(name, flip=flip).nlp.problem.table() for name in ("srmp", LAST))
        return [*first, *terms_table(self._joint_options()), *last]

    def plan(
        self,
        task: JumpTask,
        method: str = USUAL,
        *,
        weights: Mapping[str, float] | None = None,
        start: np.ndarray | None = None,
    ) -> JumpPlan:
        """Plan one jump.

        Parameters
        ----------
        task : the target.
        method : "direct" (the whole body alone) or "three-step" (SRMP, joint-space QPs, whole body; as in the paper),
            for targets in the plane. "usual" is "direct", which takes less time and ends in jumps of less effort
            (``notebooks/10_benchmark``), but "three-step" where something of stages 1 and 2, or of stage 3's tracking,
            is changed.
        weights : of cost terms in this plan, instead of their own; names as in :class:`Planner`. With 0 an own term is
            left out: the plan is that of a planner without it, to the last bit.
        start : absolute link angles (5,) of the posture in which the robot waits at rest, soles flat; the stance if
            None. Not for flips, nor for robots that no plane describes.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            If a stage refuses or fails; no later stage is run.
        """
        require_type(task, JumpTask, "the target")
        method = self.chosen(method, weights)
        self._check(task, method, start)
        asked = self.prepared(method, weights, task)
        if (less := self._less(asked)) is not self:
            return less.plan(task, method, start=start)
        if method == "direct":
            return self._finished(method, self._direct(task, asked[LAST].weights, start))
        if task.rotation_rad:
            return self._flip(task, asked)
        srmp, joints = self._first_two(task, start, asked)
        last = self.stage(LAST)
        begin = motion_of_joints(joints, last, srmp.toe_s)
        body = last.plan(task, srmp, begin=begin, weights=asked[LAST].weights, stance=self._posture(start))
        return self._finished(method, body, srmp, joints, (_joint_row(joints),))

    def _check(self, task: JumpTask, method: str, start: np.ndarray | None) -> None:
        """Refuse a target or a start that a method or the robot has no place for, before anything is solved."""
        if method != "direct" and not task.in_plane:
            raise InputError(
                f"method {quoted(method)}: stages 1 and 2 are planar, and this target goes to the "
                f"side or turns; choose 'direct'"
            )
        if start is not None and not self.robot.planar:
            raise InputError(f"robot {self.robot.name} begins in its stance: five links do not describe it; drop start")
        if start is not None and task.rotation_rad:
            raise InputError("a flip begins in the stance; leave its start away, or ask for no rotation")
        self.stage("direct", flip=bool(task.rotation_rad)).check_ground(task)

    def _direct(
        self,
        task: JumpTask,
        weights: Mapping[str, float] | None = None,
        start: np.ndarray | None = None,
        near: WholeBodyPlan | None = None,
    ) -> WholeBodyPlan:
        """The whole body alone.

        Raises :class:`InfeasibleError` where it finds nothing and a straight push cannot reach the target either, with
        the bound of that push.
        """
        planner, stance, short = self.stage("direct", flip=bool(task.rotation_rad)), self._posture(start), None
        if self.atlas is not None and not weights and near is None and task.in_plane and not task.rotation_rad:
            if (body := self.atlas.solve(self.program(task), task, stance)) is not None:
                return body
        if self.robot.planar and task.in_plane:
            try:
                check_reachable(task, self.stage("reach"), self.robot)
            except InfeasibleError as e:
                short = e
        explained = EXPLAINED.set(EXPLAINED.get() and short is None)
        try:
            return planner.plan(task, weights=weights, stance=stance, near=near)
        except SolverError as e:
            if short is None:
                raise
            said = f"{short}; the whole body, arms and trunk included, was tried: no plan found"
            raise InfeasibleError(said, number=short.number, bound=short.bound) from e
        finally:
            EXPLAINED.reset(explained)

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
        robot = self.robot.under_gravity(body.task.gravity)
        return JumpPlan(body.task, robot, method, make_tape(body, srmp), srmp, joints, body, rows, skipped)

    def follow(
        self, contacts: Contacts, *, gravity: float = GRAVITY, weights: Mapping[str, float] | None = None
    ) -> JumpPlan:
        """Plan a motion along a contact schedule: hops, run-ups, leaps, bounds, or one of your own.

        Parameters
        ----------
        contacts : the schedule; it ends at rest.
        gravity : [m/s^2].
        weights : of cost terms of stage "whole body" in this plan, instead of their own.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            If the schedule does not fit the robot, or no motion follows it.
        """
        require_type(contacts, Contacts, "the contact schedule")
        if contacts.ends != "rest":
            raise InputError("a schedule that ends at touchdown is a standing jump; ask for it by its target")
        asked = sorted_out(weights=weights)[LAST]
        how = {"contacts": contacts, "keep": self.keep, "changes": self.changes[LAST], "body": self._model}
        last = WholeBodyPlanner(self.robot, limits=self.limits, **how)
        level = JumpTask(0.0, 0.1, gravity=gravity)  # a schedule has its own places; of a target only gravity is taken
        body, ends = last.plan(level, weights=asked.weights), contacts.places[-2:]
        tape = body.tape
        rise = tape.extra["com"][tape.phase == "flight", 2]
        travel, turn = tape.extra["soles_travel"], float(tape.extra["feet_turn"])
        task = JumpTask(
            float(travel[0]),
            max(LEAST_RISE_M, float(rise.max() - rise[0]) if len(rise) else 0.0),
            contacts.surface[0] if ends else 0.0,
            gravity=gravity,
            side_m=float(travel[1]),
            yaw_rad=turn,
        )
        return replace(self._finished("direct", replace(body, task=task)), contacts=contacts)

    def _flip(self, task: JumpTask, asked: Mapping[str, StageChanges]) -> JumpPlan:
        """Three steps of a flip. Stage 2 may lose it: rates of 20 rad/s in every link are no feedback's business, and
        its reference says nothing of the tuck. Stage 3 then starts from postures of a flip, and the plan says so.
        """
        last, weights = self.stage(LAST, flip=True), asked[LAST].weights
        srmp = self.stage("srmp", flip=True).plan(task, weights=asked["srmp"].weights)
        joints, begin, skipped, rows = None, None, None, ()
        try:
            joints = self._joints(srmp, asked)
            rows, begin = (_joint_row(joints),), motion_of_joints(joints, last, srmp.toe_s)
        except SolverError as e:
            skipped = f"{e}; {OTHERWISE}"
        body = last.plan(task, srmp, begin=begin, weights=weights)
        if joints is not None and not body.began(GIVEN[0].name):
            skipped, joints = f"stage 2: its motion led nowhere; {OTHERWISE}", None
        return self._finished("three-step", body, srmp, joints, rows, skipped)

    def _first_two(
        self, task: JumpTask, start: np.ndarray | None, asked: Mapping[str, StageChanges]
    ) -> tuple[SrmpPlan, JointPlan]:
        """Stages 1 and 2."""
        q0 = None if start is None else self._standing(start)
        srmp = self._pendulum(task, start, weights=asked["srmp"].weights)
        try:
            return srmp, self._joints(srmp, asked, step_s=STEPS_S, q0=q0)
        except SolverError:  # at its limits a jump needs more of them
            return srmp, self._joints(srmp, asked, q0=q0)

    def _posture(self, start: np.ndarray | None) -> np.ndarray | None:
        """The same as :meth:`_standing`; None for the stance."""
        return None if start is None else self._standing(start)

    def _standing(self, start: np.ndarray) -> np.ndarray:
        """Configuration (nq,) of a posture (5,) in which the robot waits, the middle of the soles at the origin."""
        return configuration(self.robot, start, toe=-self.robot.sagittal.sole_center)

    def _joints(self, srmp: SrmpPlan, asked: Mapping[str, StageChanges], **how: Any) -> JointPlan:
        """Stage 2 with its own rows, weights and switches. All its roll-outs pass here."""
        own, now = self.changes["joint qp"], asked["joint qp"]
        changes = {"terms": own.terms, "weights": {**own.weights, **now.weights}, "off": own.off}
        how |= {name: value for name, value in changes.items() if value}
        return map_to_joints(srmp, self.robot.under_gravity(srmp.task.gravity), method="direct", **how)

    def _pendulum(self, task: JumpTask, start: np.ndarray | None, **how: Any) -> SrmpPlan:
        """Stage 1, from the rod of a posture in which the robot waits."""
        return self.stage("srmp").plan(task, start=None if start is None else rod_of(self.robot, start), **how)

    def replan(self, previous: JumpPlan, task: JumpTask, *, start: np.ndarray | None = None) -> JumpPlan:
        """Plan a target close to one that has a plan of this robot, by the same method and beginning with that plan.

        Stages 1 and 3 begin with their previous solutions. Stage 2, whose result is only a start for stage 3, is left
        out: the previous whole body is the better one. Where a previous solution leads nowhere, the stage starts anew.
        A flip is planned anew. ``start`` as in :meth:`plan`.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            As :meth:`plan`.
        """
        if previous.robot.hash != self.robot.hash:
            raise InputError(f"the previous plan is for the robot {previous.robot.name}, not for {self.robot.name}")
        if task.rotation_rad or previous.contacts is not None or previous.whole_body is None:
            return self.plan(task, previous.method, start=start)
        self._check(task, previous.method, start)
        self.prepared(previous.method, task=task)
        near = previous.whole_body
        if previous.method == "direct":
            return self._finished("direct", self._direct(task, start=start, near=near))
        srmp = self._pendulum(task, start, near=previous.srmp)
        body = self.stage(LAST).plan(task, srmp, near=near, stance=self._posture(start))
        return self._finished(previous.method, body, srmp)


_HERE: dict[tuple, Planner] = {}


def here(planner: Planner) -> Planner:
    """This process's own of a planner that came with a piece of work: each copy would build its stages anew."""
    if planner.token not in _HERE:
        _HERE.clear()  # one at a time: stages are large
        _HERE[planner.token] = planner
    return _HERE[planner.token]


def _row(stage: str, s: Statistics) -> StageRow:
    return StageRow(stage, s.iterations, s.build_s, s.solve_s)


def _joint_row(joints: JointPlan) -> StageRow:
    s = joints.statistics
    return StageRow("2 joint map" + ", gentle" * bool(joints.gentle), s.iterations, s.total_s - s.solve_s, s.solve_s)


def body_rows(stage: str, body: WholeBodyPlan) -> tuple[StageRow, ...]:
    """The cost of the whole-body program, one row for each attempt."""
    build_s = body.solution.statistics.build_s
    return tuple(
        StageRow(f"{stage}, {x.start}, {x.hessian}", x.iterations, 0.0 if k else build_s, x.cpu_s)
        for k, x in enumerate(body.attempts)
    )


def motion_of_joints(joints: JointPlan, planner: WholeBodyPlanner, toe_s: float) -> Motion:
    """Stage 2's roll-out as a motion that stage 3 begins with; ``toe_s`` is the length of the toe phase [s]."""
    charts = planner.body.model.of_pinocchio(joints.q)
    takeoff, end = float(joints.t[int(np.argmax(joints.phase == "flight"))]), float(joints.t[-1])
    times = planner.mesh.nodes(takeoff - toe_s, takeoff, end)
    rows = [np.stack([np.interp(t, joints.t, x) for x in charts.T], -1) for t in times.values()]
    return Motion(np.array([t[-1] - t[0] for t in times.values()]), rows)


def make_tape(body: WholeBodyPlan, srmp: SrmpPlan | None = None) -> Tape:
    """The 1 kHz tape of a whole-body plan; of a jump in the plane with planar and stage-1 trajectories by name."""
    robot, tape, jump = body.schedule.body.robot, body.tape, body.schedule.contacts.ends == "touchdown"
    if not (robot.planar and body.task.in_plane and jump):
        return tape
    planar = planar_columns(tape, robot.under_gravity(body.task.gravity))
    return replace(tape, extra={**tape.extra, **planar, **_of_stage1(srmp)})


def _of_stage1(srmp: SrmpPlan | None) -> dict[str, np.ndarray]:
    """Stage 1's columns under the names that they have on a tape."""
    parts = [] if srmp is None else [("launch", srmp.launch), ("flight", srmp.flight)]
    return {f"srmp_{name}_{k}": np.array(v) for name, part in parts for k, v in vars(part).items()}
