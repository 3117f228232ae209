"""A finished plan: what it holds, and what ``summary.json`` says of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from jumplab.arguments import checked
from jumplab.errors import InputError, Shown
from jumplab.io.columns import Named, Rows
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import Solution
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.reconstruction import planar_columns
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body import Contacts, WholeBodyPlan
from jumplab.stages.whole_body.starts import Attempt
from jumplab.stages.whole_body.tape import feet_of
from jumplab.task import JumpTask

if TYPE_CHECKING:  # loaded with the first audit
    from jumplab.auditing import AuditReport

NO_SEEDS = "none: no stage draws a random number, and a plan made twice is the same"


@dataclass(frozen=True)
class StageRow:
    """One line of the table of stages: what it cost. Times in seconds, wall clock."""

    stage: str
    iterations: int
    build_s: float
    solve_s: float


@checked
@dataclass(frozen=True, repr=False)
class JumpPlan(Shown, Named):
    """A finished plan.

    Attributes
    ----------
    task, robot, method : the target, the robot under its gravity, and how it was planned.
    tape : the 1 kHz tape of the full robot.
    summary : what ``summary.json`` says: target, results, cost of the stages; plain types.
    srmp, joints : results of stages 1 and 2 (None for the direct planner; re-plans and flips have
        no stage 2).
    whole_body : result of stage 3 or of the direct planner; results of stages are None if the plan
        was read from a result folder.
    contacts : the schedule that was asked for; None for a standing jump.
    landings : whether it landed, of each simulation by :func:`jumplab.simulate`.
    """

    task: JumpTask
    robot: Robot
    method: str
    tape: Tape
    summary: Mapping[str, Any]
    srmp: SrmpPlan | None = None
    joints: JointPlan | None = None
    whole_body: WholeBodyPlan | None = None
    contacts: Contacts | None = None
    landings: list[bool] = field(default_factory=list, init=False, compare=False)

    @classmethod
    def of(
        cls,
        robot: Robot,
        method: str,
        body: WholeBodyPlan,
        srmp: SrmpPlan | None = None,
        joints: JointPlan | None = None,
        *,
        contacts: Contacts | None = None,
    ) -> JumpPlan:
        """The plan that results of the stages make; arguments as attributes of the same names, the
        robot as on Earth.
        """
        robot = robot.under_gravity(body.task.gravity)
        tape = make_tape(body, srmp)
        summary = planned(tape) | _summary(robot, method, tape, body, srmp, joints)
        if contacts is not None:
            summary["contacts"] = [p.feet for p in contacts.phases]
            summary["over"] = contacts.over
            if contacts.aimed:
                summary["planned_distance_m"] = flown(tape, robot)
        return cls(body.task, robot, method, tape, summary, srmp, joints, body, contacts)

    @classmethod
    def on_file(cls, tape: Tape, robot: Robot, summary: Mapping[str, Any]) -> JumpPlan:
        """The plan of a result folder: its ``tape`` and its ``summary`` (a mapping); raises
        :class:`InputError` for one without target or method.
        """
        if "method" not in summary:
            raise InputError("the summary of the plan lacks the method; plan the jump again")
        task = JumpTask.of(summary.get("target", {}))
        return cls(task, robot, summary["method"], tape, dict(summary))

    def line(self) -> str:
        """Robot, target and duration; once it was audited, why that fails or it can hardly land,
        and how simulations ended.
        """
        jump = f"{self.planned_distance_m:.2f} m far"
        if not self.task.in_plane:
            jump += f", {self.planned_side_m:.2f} m to the left"
        if self.task.rotation_rad:
            jump += f", turned by {round(math.degrees(self.task.rotation_rad))} deg"
        jump += f", rise {self.planned_rise_m:.2f} m"
        method = self.method + " without stage 2" * (self.srmp is not None and self.joints is None)
        words = f"{self.robot.name}, {jump}, {method}, {float(self.tape.t[-1]):.2f} s"
        if "audit" not in vars(self) or (self.audit.sound and all(self.landings)):
            return words
        return f"{words}; {self.verdict}"

    @cached_property
    def audit(self) -> AuditReport:
        """Its audit, made when it is first asked for; see :func:`jumplab.audit`."""
        from jumplab.auditing import audit

        ground = {"edge_m": self.summary["platform_edge_m"], "over": self.summary.get("over")}
        return audit(self.tape, self.robot, self.task, **ground)

    @property
    def verdict(self) -> str:
        """The audit's verdict, and in how many of its simulations it has not landed."""
        words = self.audit.line()
        if self.landings:
            words += f"; not landed in {self.landings.count(False)} of {len(self.landings)} tries"
        return words

    @property
    def statistics(self) -> tuple[StageRow, ...]:
        """One row per stage."""
        return Rows(StageRow(**row) for row in self.summary["stages"])

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """Starts of the whole-body program that were tried, what they took, and how they ended."""
        return Rows(Attempt(**row) for row in self.summary.get("attempts", ()))

    @property
    def schedule(self) -> tuple[str, ...]:
        """Feet that carry, phase by phase, as in :class:`jumplab.Contacts`; empty for a standing
        jump.
        """
        return tuple(self.summary.get("contacts", ()))

    @property
    def t(self) -> np.ndarray:
        """Time (N,) of the tape [s]; take-off appears twice."""
        return self.tape.t

    @property
    def com(self) -> np.ndarray:
        """CoM (N, 3) over :attr:`t` [m]: x forward, y to the left, z up, as a simulation has it."""
        return self.tape.extra["com"]

    @property
    def com_velocity(self) -> np.ndarray:
        """Velocity (N, 3) of the CoM over :attr:`t` [m/s]."""
        return self.tape.extra["com_velocity"]

    @property
    def L(self) -> np.ndarray:
        """Angular momentum (N,) about the CoM, about +y, over :attr:`t` [kg m^2/s]."""
        return self.tape.extra["angular_momentum"][:, 1]

    @property
    def planned_distance_m(self) -> float:
        """Travel of the toe over the whole tape, of the middle between the soles in a jump out of
        the plane [m]; of a target with steps, or a take-off or a landing on one foot, of the last
        flight.
        """
        return self.summary["planned_distance_m"]

    @property
    def planned_side_m(self) -> float:
        """Travel of the middle between the soles to the left [m], on the tape."""
        return self.summary.get("planned_side_m", 0.0)

    @property
    def planned_yaw_rad(self) -> float:
        """Turn of the feet about the vertical [rad], on the tape."""
        return self.summary.get("planned_yaw_rad", 0.0)

    @property
    def planned_rise_m(self) -> float:
        """CoM apex minus CoM at take-off [m], in the tape's highest flight."""
        return self.summary["planned_rise_m"]

    @property
    def planned_apex_m(self) -> float | None:
        """CoM apex minus CoM of the robot that stands and waits [m]: less than the rise, since legs
        are bent at take-off. None in folders of earlier versions.
        """
        return self.summary.get("planned_apex_m")

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Cost weights of the stages, as solved: stage -> "phase/term" -> weight."""
        return self.summary["manifest"]["weights"]

    @property
    def solvers(self) -> dict[str, dict]:
        """Reports of the solvers: stage -> status, iterations, size, cost, worst re-evaluated
        residual (scaled).
        """
        return self.summary["manifest"]["solvers"]

    def terms(self) -> Rows:
        """All terms and bounds of the stages as solved; a notebook shows them as a table.

        Returns
        -------
        rows as of :meth:`jumplab.Planner.terms`, of costs of stages 1 and 3 also their ``share`` of
        the cost, of constraints the ``node`` where they are tightest and the ``slack`` there
        [unit]. Empty for a plan that was read from a folder.
        """
        rows = [] if self.srmp is None else _terms(self.srmp.solution)
        rows += [] if self.joints is None else self.joints.problem.table()
        return Rows(rows + ([] if self.whole_body is None else _terms(self.whole_body.solution)))


def make_tape(body: WholeBodyPlan, srmp: SrmpPlan | None = None) -> Tape:
    """The 1 kHz tape of a whole-body plan; of a jump in the plane with planar and stage-1
    trajectories by name, (n,) or (n, size) each.
    """
    robot = body.schedule.body.robot
    jump = body.schedule.contacts.ends == "touchdown"
    if not (robot.planar and body.task.in_plane and jump):
        return body.tape
    columns = planar_columns(body.tape, robot.under_gravity(body.task.gravity))
    if srmp is not None:
        columns |= {
            f"srmp_{name}_{key}": np.array(values)
            for name in ("launch", "flight")
            for key, values in vars(getattr(srmp, name)).items()
        }
    return replace(body.tape, extra={**body.tape.extra, **columns})


# what is said of it
# ----------------------------------------------------------------------------------------------
def planned(tape: Tape) -> dict[str, float]:
    """Distance, rise and other measures of a tape's motion; also to the side, unless the motion is
    in the plane.
    """
    extra = tape.extra
    height = extra["com"][:, 2]
    flights = [height[rows] for rows in tape.flights] or [height]
    rise, apex = max((float(x.max() - x[0]), float(x.max())) for x in flights)
    ahead, left, _ = extra["soles_travel"].tolist()
    high = {"planned_rise_m": rise, "planned_apex_m": apex - float(height[0])}
    if "planar_toe" in extra:
        toe = extra["planar_toe"]
        return {"planned_distance_m": float(toe[-1, 0] - toe[0, 0]), **high}
    aside = {"planned_side_m": left, "planned_yaw_rad": float(extra["feet_turn"])}
    return {"planned_distance_m": ahead, **high, **aside}


def flown(tape: Tape, robot: Robot) -> float:
    """Distance ahead [m] that the last flight covers: of the feet in the end, from where they stood
    first, less that of those that leave.
    """
    takeoff = tape.flights[-1].start
    origin, turn = feet_of(robot, tape.q[[0, takeoff, -1]])
    toes = (origin + turn @ robot.foot.tip)[..., 0]  # (3, 2)
    ahead = toes[1:] - toes[0]
    return float(ahead[1].mean() - ahead[0, tape.contacts[takeoff - 1] > 0].mean())


def _summary(
    robot: Robot,
    method: str,
    tape: Tape,
    body: WholeBodyPlan,
    srmp: SrmpPlan | None,
    joints: JointPlan | None,
) -> dict[str, Any]:
    weights = {}
    solvers = {}
    rows = []
    if srmp is not None:
        weights["SRMP"], solvers["SRMP"] = _solved(srmp.solution)
        s = srmp.solution.statistics
        rows.append(StageRow("1 SRMP", s.iterations, s.build_s, s.solve_s))
    if joints is not None:
        s = joints.statistics
        costs = [(phase, term) for phase, term in joints.problem.terms() if term.is_cost]
        weights["joint map"] = {f"{phase}/{term.name}": term.weight for phase, term in costs}
        solvers["joint map"] = {
            "solver": "proxqp",
            "problems": s.steps,
            "iterations": s.iterations,
            "residual": s.worst_residual,
        }
        rows.append(StageRow("2 joint map", s.iterations, s.total_s - s.solve_s, s.solve_s))
    weights["whole body"], solvers["whole body"] = _solved(body.solution)
    build_s = body.solution.statistics.build_s
    stage = "direct" if srmp is None else "3 whole body"
    for x in body.attempts:
        rows.append(StageRow(f"{stage}, {x.start}, {x.hessian}", x.iterations, build_s, x.cpu_s))
        build_s = 0.0
    return {
        "target": body.task.numbers,
        "method": method,
        "robot": {"name": robot.name, "hash": robot.hash, "mass_kg": robot.total_mass},
        "launch_s": body.launch_s,
        "flight_s": body.flight_s,
        "platform_edge_m": body.edge_m,
        "peak_torque_nm": _peaks(tape.joint_names, tape.tau),
        "peak_speed_rad_s": _peaks(tape.joint_names, tape.v[:, 6:]),
        "stages": [asdict(row) for row in rows],
        "attempts": [asdict(x) for x in body.attempts],
        "manifest": {"weights": weights, "solvers": solvers, "seeds": NO_SEEDS},
    }


def _solved(solution: Solution) -> tuple[dict[str, float], dict[str, Any]]:
    """Weights of a solution's costs, and the statistics of its solver."""
    weights = {f"{row['phase']}/{row['name']}": row["weight"] for row in solution.cost_shares}
    statistics = vars(solution.statistics).items()
    times = ("build_s", "solve_s")  # these stand in the table of stages
    return weights, {"solver": "ipopt", **{k: v for k, v in statistics if k not in times}}


def _terms(solution: Solution) -> list[dict[str, Any]]:
    used = {
        (row["phase"], row["name"]): row
        for row in (*solution.constraint_report, *solution.cost_shares)
    }
    rows = []
    for row in solution.problem.table():
        result = used.get((row["phase"], row["name"]), {})
        if "weight" in result:
            row["value"] = f"weight {result['weight']:g}"
        rows.append(row | {key: result.get(key) for key in ("share", "node", "slack")})
    return rows


def _peaks(names: Sequence[str], values: np.ndarray) -> dict[str, float]:
    return {str(n): float(x) for n, x in zip(names, np.abs(values).max(axis=0), strict=True)}
