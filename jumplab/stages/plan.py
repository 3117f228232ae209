"""A finished plan: what it holds, and what ``summary.json`` says of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from jumplab.errors import Shown
from jumplab.io.columns import Named
from jumplab.io.tape import Tape
from jumplab.ocp.nlp import Solution, Statistics
from jumplab.robot import Robot
from jumplab.stages.joint_qp import JointPlan
from jumplab.stages.joint_qp.changes import terms_table
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.whole_body import Contacts, WholeBodyPlan
from jumplab.stages.whole_body.planner import Attempt
from jumplab.task import JumpTask

TRACKED = {"rho": "rho", "rho_rate": "rho_rate", "velocity": "com_velocity", "L": "L"}  # names on the tape
NO_SEEDS = "none: no stage draws a random number, and a plan made twice is the same"


@dataclass(frozen=True)
class StageRow:
    """One line of the table of stages: what it cost. Times in seconds, wall clock."""

    stage: str
    iterations: int
    build_s: float
    solve_s: float


@dataclass(frozen=True, repr=False)
class JumpPlan(Shown, Named):
    """A finished plan.

    Attributes
    ----------
    task, robot, method : what was asked, of whom (under the task's gravity), and how it was planned.
    tape : the 1 kHz tape of the full robot.
    srmp, joints : results of stages 1 and 2 (None for the direct planner; a re-plan has no stage 2).
    whole_body : result of stage 3 or of the direct planner; None if the plan was read from a result folder.
    statistics : one row per stage; stage 2's is called "2 joint map, gentle" where it had to follow less closely.
    skipped : why stage 2 is missing, in a flip that it cannot follow; None if nothing is.
    stored : the summary that the plan was read with; None if it has just been made.
    contacts : the schedule that was asked for; None for a standing jump.
    """

    task: JumpTask
    robot: Robot
    method: str
    tape: Tape
    srmp: SrmpPlan | None
    joints: JointPlan | None
    whole_body: WholeBodyPlan | None
    statistics: tuple[StageRow, ...]
    skipped: str | None = None
    stored: Mapping[str, Any] | None = None
    contacts: Contacts | None = None

    @classmethod
    def on_file(cls, tape: Tape, robot: Robot, summary: Mapping[str, Any]) -> JumpPlan:
        """The plan of a result folder: its tape and its summary; the stages' own results are not on file."""
        target = summary["target"]
        task = JumpTask(**{f.name: target[f.name] for f in fields(JumpTask) if f.name in target})
        rows = tuple(StageRow(**row) for row in summary["stages"])
        return cls(task, robot, summary["method"], tape, None, None, None, rows, summary.get("skipped"), summary)

    def line(self) -> str:
        """Robot, target and duration."""
        turned = "" if self.task.in_plane else f", {self.planned_side_m:.2f} m to the left"
        turned += f", turned by {round(math.degrees(self.task.rotation_rad))} deg" if self.task.rotation_rad else ""
        jump = f"{self.planned_distance_m:.2f} m far{turned}, rise {self.planned_rise_m:.2f} m"
        return f"{self.robot.name}, {jump}, {self.method}, {float(self.tape.t[-1]):.2f} s"

    @property
    def attempts(self) -> tuple[Attempt, ...]:
        """Starts of the whole-body program that were tried, what they took, and how they ended."""
        if self.stored is not None:
            return tuple(Attempt(**row) for row in self.stored.get("attempts", ()))
        return () if self.whole_body is None else self.whole_body.attempts

    @property
    def schedule(self) -> tuple[str, ...]:
        """Feet that carry, phase by phase, as in :class:`jumplab.Contacts`; empty for a standing jump."""
        if self.stored is not None:
            return tuple(self.stored.get("contacts", ()))
        return () if self.contacts is None else tuple(p.feet for p in self.contacts.phases)

    @property
    def t(self) -> np.ndarray:
        """Time (N,) of the tape [s]; take-off appears twice."""
        return self.tape.t

    @property
    def planned_distance_m(self) -> float:
        """Travel of the toe over the whole tape, of the middle between the soles in a jump out of the plane [m]."""
        if self._spatial:
            return float(self.tape.extra["soles_travel"][0])
        toe = self.tape.extra["planar_toe"]
        return float(toe[-1, 0] - toe[0, 0])

    @property
    def _spatial(self) -> bool:
        return "planar_toe" not in self.tape.extra

    @property
    def toe_phase_s(self) -> float:
        """When the heels rise, on the tape [s]."""
        return float(self.tape.extra["toe_phase_start" if self._spatial else "planar_toe_phase_start"])

    @property
    def planned_side_m(self) -> float:
        """Travel of the middle between the soles to the left [m], on the tape."""
        return float(self.tape.extra["soles_travel"][1]) if self._spatial else 0.0

    @property
    def planned_yaw_rad(self) -> float:
        """Turn of the feet about the vertical [rad], on the tape."""
        return float(self.tape.extra.get("feet_turn", 0.0))

    @property
    def planned_rise_m(self) -> float:
        """CoM apex minus CoM at take-off [m], on the tape."""
        extra = self.tape.extra
        com = (extra["com"] if "com" in extra else extra["planar_com"])[self.tape.takeoff_index :, -1]
        return float(com.max() - com[0])

    @property
    def weights(self) -> dict[str, dict[str, float]]:
        """Cost weights of the stages, as solved: stage -> "phase/term" -> weight."""
        if self.stored is not None:
            return self.stored["manifest"]["weights"]
        found = {"whole body": _weights(self.whole_body.solution)}
        if self.joints is not None:
            o = self.joints.options
            qps = {f"{phase}/{k}": w for phase in ("launch", "flight") for k, w in vars(getattr(o, phase)).items()}
            found = {"joint map": qps, **found}
        if self.srmp is not None:
            found = {"SRMP": _weights(self.srmp.solution), **found}
        return found

    def terms(self) -> list[dict[str, Any]]:
        """All terms and bounds of the stages as solved; ``jl.plots.table`` shows them.

        Returns
        -------
        rows as of :meth:`jumplab.Planner.terms`, of costs of stages 1 and 3 also their ``share`` of the cost, of
        constraints the ``node`` where they are tightest and the ``slack`` there [unit]. Empty for a plan that was read
        from a folder.
        """
        first = [] if self.srmp is None else _terms(self.srmp.solution)
        second = [] if self.joints is None else terms_table(self.joints.options)
        return [*first, *second, *([] if self.whole_body is None else _terms(self.whole_body.solution))]

    @property
    def solvers(self) -> dict[str, dict]:
        """What the solvers said: stage -> status, iterations, size, cost, worst re-evaluated residual (scaled)."""
        if self.stored is not None:
            return self.stored["manifest"]["solvers"]
        found = {} if self.srmp is None else {"SRMP": _solver(self.srmp.solution.statistics)}
        if self.joints is not None:
            s = self.joints.statistics
            found["joint map"] = {"solver": s.method, "problems": s.steps, "iterations": s.iterations,
                                  "residual": s.worst_residual}  # fmt: skip
            if self.joints.gentle:
                found["joint map"]["gentle"] = self.joints.gentle
        return {**found, "whole body": _solver(self.whole_body.solution.statistics)}

    @property
    def tracking(self) -> dict[str, dict[str, dict[str, float | None]]] | None:
        """How far the tape is from stage 1's trajectories, compared at the same share of each phase (WL-J1, WF-J1).

        Returns
        -------
        phase ("launch", "flight") -> "rho" [kg m^2], "rho_rate" [kg m^2/s], "velocity" of the CoM [m/s], "L" [kg m^2/s]
        -> "rms" of the difference, and "relative_rms", its share of the reference's mean size (None where that is
        zero). None for a plan without stage 1.
        """
        if self.stored is not None:
            return self.stored.get("tracking")
        return None if self.srmp is None else _tracking(self.tape, self.srmp)

    @property
    def summary(self) -> dict:
        """What ``summary.json`` says: target, method, results, cost of the stages; plain types."""
        if self.stored is not None:
            return dict(self.stored)
        body, away = self.whole_body, {}
        if self._spatial:
            away = dict(planned_side_m=self.planned_side_m, planned_yaw_rad=self.planned_yaw_rad)
        return {
            "target": asdict(self.task),
            "method": self.method,
            "robot": {"name": self.robot.name, "hash": self.robot.hash, "mass_kg": self.robot.total_mass},
            "planned_distance_m": self.planned_distance_m,
            "planned_rise_m": self.planned_rise_m,
            **away,
            "launch_s": body.launch_s,
            "flight_s": body.flight_s,
            "platform_edge_m": body.edge_m,
            "peak_torque_nm": _peaks(self.tape.joint_names, self.tape.tau),
            "peak_speed_rad_s": _peaks(self.tape.joint_names, self.tape.v[:, 6:]),
            **({"tracking": self.tracking} if self.srmp else {}),
            "stages": [vars(row) for row in self.statistics],
            **({"skipped": self.skipped} if self.skipped else {}),
            **({"contacts": list(self.schedule)} if self.contacts else {}),
            **({"attempts": [vars(x) for x in self.attempts]} if self.attempts else {}),
            "manifest": {"weights": self.weights, "solvers": self.solvers, "seeds": NO_SEEDS},
        }


def _tracking(tape: Tape, srmp: SrmpPlan) -> dict[str, dict[str, dict[str, float | None]]]:
    k = tape.takeoff_index
    toe = float(tape.extra["planar_toe_phase_start"])
    launch = np.interp(tape.t[:k], [0, toe, tape.takeoff_time], [0, srmp.launch_s - srmp.toe_s, srmp.launch_s])
    air = tape.t[k:] - tape.takeoff_time
    found = {}
    for name, rows, t in (("launch", slice(k), launch), ("flight", slice(k, None), air * srmp.flight_s / air[-1])):
        part, found[name] = getattr(srmp, name), {}
        for key, column in TRACKED.items():
            asked = np.array([np.interp(t, part.t, x) for x in np.atleast_2d(getattr(part, column).T)])
            done = np.atleast_2d(tape.extra[f"planar_{column}"][rows].T)
            rms = float(np.sqrt(np.mean(np.sum((done - asked) ** 2, axis=0))))
            size = float(np.mean(np.linalg.norm(asked, axis=0)))
            found[name][key] = {"rms": rms, "relative_rms": rms / size if size else None}
    return found


def _solver(s: Statistics) -> dict:
    times = ("build_s", "solve_s")  # these stand in the table of stages
    return {"solver": "ipopt", **{k: v for k, v in vars(s).items() if k not in times}}


def _terms(solution: Solution) -> list[dict[str, Any]]:
    costs = {(r["phase"], r["name"]): r for r in solution.cost_shares}
    tight = {(r["phase"], r["name"]): r for r in solution.constraint_report}
    rows = []
    for row in solution.problem.table():
        cost, limit = (found.get((row["phase"], row["name"]), {}) for found in (costs, tight))
        value = f"weight {cost['weight']:g}" if cost else row["value"]
        found = dict(share=cost.get("share"), node=limit.get("node"), slack=limit.get("slack"))
        rows.append(row | {"value": value} | found)
    return rows


def _weights(solution: Solution) -> dict[str, float]:
    return {f"{row['phase']}/{row['name']}": row["weight"] for row in solution.cost_shares}


def _peaks(names, values) -> dict[str, float]:
    return {str(n): float(x) for n, x in zip(names, np.abs(values).max(axis=0), strict=True)}
