"""From a target to a finished plan: the paper's three steps in order (or the direct planner), then
the 1 kHz tape.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np

from jumplab.arguments import checked
from jumplab.errors import InputError, Shown, quoted, require_type
from jumplab.io.columns import Rows
from jumplab.models.full import FullBody
from jumplab.ocp import Problem, Term
from jumplab.ocp.cache import in_turn
from jumplab.ocp.solution import resampled
from jumplab.robot import Robot
from jumplab.robot.legs import size
from jumplab.robot.reach import rod_of
from jumplab.robot.stance import configuration, stance_configuration
from jumplab.stages.changes import LAST, StageChanges, named, settled, sorted_out
from jumplab.stages.joint_qp import JointPlan, changed_problem, map_to_joints
from jumplab.stages.plan import JumpPlan, planned
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.whole_body import (
    Contacts,
    Limits,
    Mesh,
    Weights,
    WholeBodyPlan,
    WholeBodyPlanner,
)
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.bounds import refuse_impossible
from jumplab.stages.whole_body.ground import surface_of_jump
from jumplab.stages.whole_body.motions import Motion
from jumplab.stages.whole_body.program import Program
from jumplab.stages.whole_body.starts import COMPARED, FOLLOWED
from jumplab.task import GRAVITY, JumpTask

METHODS = ("three-step", "direct")
USUAL = "usual"
FIRST_STAGES = "srmp", "joint qp"  # those that the direct method leaves out ...
FOLLOWING = "track "  # ... as it does the terms by which stage 3 follows them
# stage 2's steps [s]: on flat feet, on the toes, in flight; fine enough for a start
STEPS_S = (0.015, 0.0125, 0.02)
LINKS = 5  # of the robot in the plane
LEAST_RISE_M = 0.02  # that a target can say
ANY = JumpTask(0.5, 0.3)  # a jump straight ahead: its terms are those of all of them
NOTHING: Mapping[str, float] = MappingProxyType({})
_COUNT = count()


class Planner(Shown):
    """All stages for one robot, built on first use and kept for further targets.

    Whatever is changed here holds in every solve of every path: every start, finer meshes,
    re-plans, flips, the direct planner, chains. Changes that no stage would use are refused.

    Flips have other limits, settings, weights and a finer mesh; whatever is given here wins over
    those too.

    Parameters
    ----------
    robot : who jumps.
    terms : own costs and constraints: "stage/phase" -> list of :class:`jumplab.Term`. Stages "srmp"
        and "whole body" have phases flat, toe, launch (both) and flight, "joint qp" has launch and
        flight; "srmp" or "whole body" alone takes those at "problem". An expression sees a point
        with joints, joint_rates, torques, com, com_velocity, L, inertia, wrench, posture,
        point("left_hand"), time, see :class:`jumplab.stages.whole_body.instant.Instant`, and in
        stage 1 com, com_velocity, L, inertia, wrench, lean, posture, time, see
        :class:`jumplab.models.srmp.SrmpState`. The direct planner takes those of "whole body".
    weights : "stage/term" or "stage/phase/term" -> weight instead of the term's own; without a
        stage, stage 3's. For "joint qp" it is a factor on the block's own weights.
    off : names of the same sort: terms and bounds to leave out.
    limits : of stage 3: :class:`jumplab.stages.whole_body.Limits`, or a mapping of some of its
        fields.
    settings : of stage 1: :class:`jumplab.stages.srmp.SrmpSettings`, or a mapping of some of its
        fields.
    mesh : of stage 3: :class:`jumplab.stages.whole_body.Mesh`, or a mapping of some of its fields.
    keep : keep the built problems for later processes, see :mod:`jumplab.ocp.cache`.
    atlas : of plans with the same robot, terms and limits: a :class:`jumplab.Atlas`. Direct plans
        begin with it where it has something close by; other methods refuse it.

    Raises
    ------
    InputError
        In one sentence, with the names that exist, for whatever does not fit; terms are looked at
        when their stage is built, before anything is solved.
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
        self.robot = robot
        self.keep = keep
        self.changes = sorted_out(terms, weights, off)
        self.atlas = atlas
        self._size = size(robot)
        self._given = {Limits: limits, SrmpSettings: settings, Mesh: mesh}
        for kind in self._given:
            self._settings(kind, False)  # refuses what does not fit
        self._stages: dict[tuple[str, bool], Any] = {}
        self._stepping: WholeBodyPlanner | None = None
        self.token = os.getpid(), next(_COUNT)  # the same in copies that other processes get

    def line(self) -> str:
        """Robot and stages built so far."""
        return f"{self.robot.name}, built: {', '.join(self.built) or 'nothing yet'}"

    @property
    def built(self) -> tuple[str, ...]:
        """Stages that are built, those of flips with the word."""
        return tuple(name + " of flips" * flip for name, flip in self._stages)

    def __getstate__(self) -> dict[str, Any]:
        kept = {k: v for k, v in vars(self).items() if k != "_model"}
        return {**kept, "_stages": {}, "_stepping": None}  # another process builds its own

    def _settings(self, kind: type, flip: bool) -> Any:
        """Limits, stage 1's settings or mesh, of jumps or of flips."""
        given = self._given[kind]
        if kind is Mesh and isinstance(given, Mesh):
            return given
        return settled(kind, given, flip, self._size)

    @property
    def limits(self) -> Limits:
        """Stage 3's limits of jumps."""
        return self._settings(Limits, False)

    # what plans are made of
    # ------------------------------------------------------------------------------------------
    @checked
    @in_turn
    def stage(self, name: str, *, flip: bool = False) -> Any:
        """A stage's planner, of jumps or of flips: "srmp", "direct", "whole body" (which
        follows stage 1).
        """
        if (name, flip) not in self._stages:
            if name == "srmp":
                given = self.robot, self._settings(SrmpSettings, flip)
                stage = SrmpPlanner(*given, keep=self.keep, changes=self.changes["srmp"])
            else:
                weights = settled(Weights, None, flip, self._size)
                given = self._settings(Mesh, flip), self._settings(Limits, flip), weights
                stage = self._whole_body(*given, tracking=name == LAST)
            self._stages[name, flip] = stage
        return self._stages[name, flip]

    def _whole_body(self, *settings: Any, **options: Any) -> WholeBodyPlanner:
        """Stage 3 with this planner's own terms and weights; arguments as it has them."""
        options |= {"keep": self.keep, "body": self._model, "changes": self.changes[LAST]}
        return WholeBodyPlanner(self.robot, *settings, **options)

    @cached_property
    def _model(self) -> Body:
        """The robot as all whole-body programs see it."""
        return Body(self.robot)

    @checked
    @in_turn
    def program(self, task: JumpTask = ANY, weights: Mapping[str, float] = NOTHING) -> Program:
        """The whole-body program that plans a target directly; ``weights`` as in :meth:`plan`
        ("term" -> weight).
        """
        return self.direct(task).program(task, weights)

    @checked
    @in_turn
    def direct(self, task: JumpTask) -> WholeBodyPlanner:
        """The direct planner of a target: that of jumps or of flips from a stand, or the one along
        the schedule of its steps and feet, of which the last is kept.
        """
        if task.standing:
            return self.stage("direct", flip=bool(task.rotation_rad))
        contacts = Contacts.to(task, self.robot, self.limits.flight_s)
        if self._stepping is None or self._stepping.contacts != contacts:
            weights = settled(Weights, None, size=self._size)
            self._stepping = self._whole_body(None, self.limits, weights, contacts=contacts)
        return self._stepping

    def _joint_changes(self, asked: StageChanges = StageChanges()) -> StageChanges:
        """Changes to stage 2, with the weights that one plan is ``asked`` for."""
        changes = self.changes["joint qp"]
        return replace(changes, weights={**changes.weights, **asked.weights})

    def _joint_problem(self, asked: StageChanges = StageChanges()) -> Problem:
        """Stage 2's problem; refuses what does not fit."""
        stance = stance_configuration(self.robot)
        return changed_problem(FullBody(self.robot), stance, changes=self._joint_changes(asked))

    @checked
    @in_turn
    def terms(self, task: JumpTask = ANY, *, method: str = USUAL) -> Rows:
        """All terms and bounds of the stages for a target, own ones included; a notebook shows them
        as a table.

        Returns
        -------
        rows with stage, phase, name, kind, at, unit, equation and value (weight, or bounds).
        """
        flip = bool(task.rotation_rad)
        if self.chosen(method) == "direct":
            return Rows(self.program(task).nlp.problem.table())
        first, last = (self.stage(name, flip=flip).nlp.problem.table() for name in ("srmp", LAST))
        return Rows([*first, *([] if flip else self._joint_problem().table()), *last])

    # what is refused
    # ------------------------------------------------------------------------------------------
    def chosen(self, method: str = USUAL, weights: Mapping[str, float] | None = None) -> str:
        """The method that is meant: "usual" is "direct", but "three-step" where something is
        changed that only it has; ``weights`` as in :meth:`plan` ("stage/term" -> weight).

        Raises :class:`InputError` for a method that does not exist, and for one that this planner
        cannot follow.
        """
        if not isinstance(method, str) or method not in (USUAL, *METHODS):
            raise InputError(f"method {quoted(method)}: choose one of {', '.join(METHODS)}")
        asked = sorted_out(weights=weights)
        if method == USUAL:
            last = self.changes[LAST], asked[LAST]
            names = (name for x in last for name in (*x.weights, *x.off))
            following = any(name.rpartition("/")[2].startswith(FOLLOWING) for name in names)
            method = METHODS[0 if following or self._of_first_stages(asked) else 1]
        if method != "direct" and self.atlas is not None:
            raise InputError(
                f"method {quoted(method)}: an atlas holds direct plans only; choose 'direct', or "
                f"leave out the atlas"
            )
        if method != "direct" and not self.robot.planar:
            raise InputError(
                f"method {quoted(method)}: it needs a planar model, which robot {self.robot.name} "
                f"does not have; choose 'direct'"
            )
        return method

    def _of_first_stages(self, asked: Mapping[str, StageChanges]) -> list[str]:
        """Changes to stages that the direct method leaves out, in words."""
        changed = [f"{s!r}" for s in FIRST_STAGES if self.changes[s] or asked[s]]
        return changed + ["the settings of 'srmp'"] * (self._given[SrmpSettings] is not None)

    @checked
    @in_turn
    def prepared(
        self, method: str = USUAL, weights: Mapping[str, float] | None = None, task: JumpTask = ANY
    ) -> dict[str, StageChanges]:
        """Build the stages that a ``method`` needs for a target, so that nothing is refused after
        the first has solved.

        Returns the ``weights`` of one plan by stage (as of :func:`.sorted_out`). Raises
        :class:`InputError` for own terms, weights or settings that the method has no place for, and
        for names that do not exist.
        """
        asked = sorted_out(weights=weights)
        if self.chosen(method, weights) == "direct":
            if ignored := self._of_first_stages(asked):
                raise InputError(
                    f"method 'direct' cannot use changes of {' and '.join(ignored)}: it takes "
                    f"limits, mesh and the terms of 'whole body'; choose 'three-step', or leave "
                    f"out these changes"
                )
            asked[LAST].applied(self.program(task, asked[LAST].weights).nlp.problem)
            return asked
        flip = bool(task.rotation_rad)
        if flip and self._joint_changes(asked["joint qp"]):
            raise InputError(
                "a flip is planned without stage 2; leave out all changes of 'joint qp'"
            )
        for name in ("srmp", LAST):
            asked[name].applied(self.stage(name, flip=flip).nlp.problem)
        if not flip:
            self._joint_problem(asked["joint qp"])
        return asked

    def _check(self, task: JumpTask, method: str, start: np.ndarray | None) -> None:
        """Refuse a target or a start that a method or the robot has no place for, before anything
        is solved.
        """
        if method != "direct" and not task.standing:
            raise InputError(
                f"method {quoted(method)}: its stages plan jumps from a stand, off both feet and "
                f"onto both; choose 'direct', or leave out takeoff, landing and run_up"
            )
        if method != "direct" and not task.in_plane:
            raise InputError(
                f"method {quoted(method)}: stages 1 and 2 are planar, and this target goes to the "
                f"side or turns; choose 'direct'"
            )
        if start is not None and np.shape(start) != (LINKS,):
            raise InputError(
                f"start has the shape {np.shape(start)}; the links have {LINKS} angles, ({LINKS},)"
            )
        if start is not None and not self.robot.planar:
            raise InputError(
                f"robot {self.robot.name}: start has the angles of five links, which do not "
                f"describe this robot; leave out start, and the plan begins in the stance"
            )
        if start is not None and task.rotation_rad:
            raise InputError(
                "a flip begins in the stance; leave out start, or set rotation_rad to 0"
            )
        if not task.standing:
            return
        limits = self._settings(Limits, bool(task.rotation_rad))
        surface_of_jump(self._model, limits, task)
        if start is None:  # elsewhere the CoM waits elsewhere
            refuse_impossible(self._model, limits, task)

    # plans
    # ------------------------------------------------------------------------------------------
    @checked
    @in_turn
    def plan(
        self,
        task: JumpTask,
        method: str = USUAL,
        *,
        weights: Mapping[str, float] | None = None,
        start: np.ndarray | None = None,
        near: JumpPlan | None = None,
        starts: int = 1,
    ) -> JumpPlan:
        """Plan one jump.

        Parameters
        ----------
        task : the target.
        method : "direct" (the whole body alone) or "three-step" (SRMP, joint-space QPs, whole body;
            as in the paper, but flips without the QPs), for targets in the plane. "usual" is
            "direct", which takes less time and ends in jumps of less effort
            (``notebooks/10_benchmark``), but "three-step" where something of stages 1 and 2, or of
            stage 3's tracking, is changed.
        weights : of cost terms in this plan, instead of their own; names as in :class:`Planner`.
        start : absolute link angles (5,) of the posture in which the robot waits at rest, soles
            flat; the stance if None. Not for flips, nor for robots that no plane describes.
        near : a plan by the same method for a target close by, to begin with; see :meth:`replan`.
        starts : how many starts are tried to the end, 1 to 10, of which the cheapest counts; by
            default the first that leads to a plan. Of the method "direct", jumps without rotation.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            If a stage refuses or fails; no later stage is run.
        """
        method = self.chosen(method, weights)
        self._check(task, method, start)
        if not (starts == 1 or (1 < starts <= len(COMPARED) and near is None)):
            raise InputError(
                f"starts = {starts} must be 1 to {len(COMPARED)}, and 1 if near is given"
            )
        if starts > 1 and (method != "direct" or task.rotation_rad or not task.standing):
            raise InputError(
                f"starts = {starts}: only method 'direct' compares several starts, and only in "
                f"jumps from a stand without rotation; leave out starts"
            )
        asked = self.prepared(method, weights, task)
        begin = {"weights": asked[LAST].weights}
        if start is not None:  # the middle of the soles is at the origin
            begin["stance"] = configuration(self.robot, start, toe=-self.robot.sagittal.sole_center)
        if near is not None:
            begin["near"] = near.whole_body
        if method == "direct":
            body = self._direct(task, begin, starts)
            contacts = None if task.standing else body.schedule.contacts
            return JumpPlan.of(self.robot, method, body, contacts=contacts)
        flip = bool(task.rotation_rad)
        last = self.stage(LAST, flip=flip)
        srmp = self.stage("srmp", flip=flip).plan(
            task,
            start=None if start is None else rod_of(self.robot, start),
            near=None if near is None else near.srmp,
            weights=asked["srmp"].weights,
        )
        joints = None
        if near is None and not flip:
            changes = self._joint_changes(asked["joint qp"])
            stance = begin.get("stance")
            joints = map_to_joints(srmp, self.robot, STEPS_S, q0=stance, changes=changes)
            begin["begin"] = motion_of_joints(joints, last, srmp.toe_s)
        body = last.plan(task, srmp, **begin)
        return JumpPlan.of(self.robot, method, body, srmp, joints)

    def _direct(self, task: JumpTask, begin: Mapping[str, Any], starts: int) -> WholeBodyPlan:
        """The whole body alone; an atlas's plan close by first, where there is one."""
        flip = bool(task.rotation_rad)
        alone = not begin["weights"] and "near" not in begin
        last = self.direct(task)
        if starts > 1:
            return last.cheapest(task, starts, **begin)
        if self.atlas is not None and alone and task.in_plane and task.standing and not flip:
            if (body := self.atlas.solve(last, task, begin.get("stance"))) is not None:
                return body
        return last.plan(task, **begin)

    @checked
    def replan(
        self, previous: JumpPlan, task: JumpTask, *, start: np.ndarray | None = None
    ) -> JumpPlan:
        """Plan a target close to one that has a plan of this robot, by the same method and
        beginning with that plan.

        Stages 1 and 3 begin with their previous solutions. Stage 2, whose result is only a start
        for stage 3, is left out: the previous whole body is the better one. Where a previous
        solution leads nowhere, the stage starts anew. A flip is planned anew, as is a target with
        other steps or feet. ``start`` (5,) as in :meth:`plan`.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            As :meth:`plan`.
        """
        if previous.robot.hash != self.robot.hash:
            raise InputError(
                f"the previous plan is for the robot {previous.robot.name} "
                f"({previous.robot.hash}), not for {self.robot.name} ({self.robot.hash}); "
                f"give a plan of this robot"
            )
        phases = [] if previous.whole_body is None else previous.whole_body.schedule.contacts.phases
        other = phases != self.direct(task).contacts.phases
        near = None if task.rotation_rad or other else previous
        return self.plan(task, previous.method, start=start, near=near)

    @checked
    @in_turn
    def follow(
        self,
        contacts: Contacts,
        *,
        gravity: float = GRAVITY,
        rise_m: float = 0.1,
        weights: Mapping[str, float] | None = None,
        motion: Motion | None = None,
        stance: np.ndarray | None = None,
    ) -> JumpPlan:
        """Plan a motion along a contact schedule: hops, run-ups, leaps, bounds, or one of your own.

        Parameters
        ----------
        contacts : the schedule; it ends at rest.
        gravity : [m/s^2].
        rise_m : of the CoM, whose take-off speed the term "follow take-off speed" asks for if it
            has a weight [m].
        weights : of cost terms of stage "whole body" in this plan, instead of their own.
        motion : along the schedule, that the plan shall be near to, and begins with.
        stance : configuration (nq,) in which it begins, soles flat in the first places.

        Raises
        ------
        InputError, InfeasibleError, SolverError
            If the schedule does not fit the robot, or no motion follows it.
        """
        if contacts.ends != "rest":
            raise InputError(
                "a schedule that ends at touchdown is a standing jump; plan it by its target, "
                "JumpTask(...), instead"
            )
        asked = sorted_out(weights=weights)[LAST]
        # a schedule has its own places; of a target only gravity and rise are taken
        level = JumpTask(0.0, rise_m, gravity=gravity)
        settings = {"limits": self.limits, "weights": settled(Weights, None, size=self._size)}
        options = {}
        if motion is not None:  # clips are of robots of one size, on which their numbers were found
            limits = replace(Limits().of_clip(), **named(Limits, self._given[Limits]))
            settings = {"limits": limits, "weights": Weights().of_clip(), "follows": True}
            options = {"begin": motion, "stance": stance, "starts": FOLLOWED}
        last = self._whole_body(contacts=contacts, **settings)
        body = last.plan(level, weights=asked.weights, **options)
        reached = planned(body.tape)
        height, _ = contacts.surface
        task = JumpTask(
            reached["planned_distance_m"],
            max(LEAST_RISE_M, reached["planned_rise_m"]),
            height,
            gravity=gravity,
            # an edge lies across the way ahead, whatever the feet do beside it
            side_m=0.0 if height else reached["planned_side_m"],
            yaw_rad=reached["planned_yaw_rad"],
        )
        return JumpPlan.of(self.robot, "direct", replace(body, task=task), contacts=contacts)


_HERE: dict[tuple, Planner] = {}


def here(planner: Planner) -> Planner:
    """This process's own of a planner that came with a piece of work: each copy would build its
    stages anew.
    """
    if planner.token not in _HERE:
        _HERE.clear()  # one at a time: stages are large
        _HERE[planner.token] = planner
    return _HERE[planner.token]


def motion_of_joints(joints: JointPlan, planner: WholeBodyPlanner, toe_s: float) -> Motion:
    """Stage 2's roll-out as a motion that stage 3 begins with; ``toe_s`` is the length of the toe
    phase [s].
    """
    charts = planner.body.model.of_pinocchio(joints.q)
    takeoff = float(joints.t[int(np.argmax(joints.phase == "flight"))])
    times = planner.mesh.nodes(takeoff - toe_s, takeoff, float(joints.t[-1])).values()
    rows = [resampled(joints.t, charts, t) for t in times]
    return Motion(np.array([np.ptp(t) for t in times]), rows)
