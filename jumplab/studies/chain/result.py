"""A finished chain, and its folder: ``chain.json``, ``chain.npz``, and a plan's folder per jump."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.auditing import AuditReport, write_audit
from jumplab.io import folder as store
from jumplab.io.folder import transaction
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.kinematics import Gauge
from jumplab.sim.result import LEVEL_TOLERANCE_M, SimulationResult
from jumplab.sim.scene import Scene
from jumplab.studies.chain.course import Course
from jumplab.studies.chain.pilot import Ahead

SCHEMA = "jumplab-chain-1"
REPORT, LOG, JUMPS = "chain.json", "chain.npz", "jumps"
PLAN_NAMES = "looked_s air foretold_m place_m bias_m solve_s cpu_s ready_s needed_s began_s".split()


@dataclass(frozen=True)
class ChainedJump:
    """One jump of a chain."""

    number: int  # from 0
    start_s: float  # time of the chain at which the log begins; the stand before the first jump belongs to it
    ahead: Ahead | None  # the plan with which it began; None if it did not
    plans: tuple[Ahead, ...]  # all that were made for it
    simulation: SimulationResult  # log up to the beginning of the next jump, its time counted from zero

    @property
    def air_s(self) -> float | None:
        """Time between lift-off and touchdown [s]; None if there was no touchdown."""
        m = self.simulation.metrics
        return None if m.touchdown_s is None or m.liftoff_s is None else m.touchdown_s - m.liftoff_s

    def on_feet(self, robot: Robot) -> bool:
        """Whether it came down, and nothing but the feet touched the ground from its start to the next jump."""
        feet = np.isin(self.simulation.link_names, robot.foot.frames)
        return self.air_s is not None and not self.simulation.touching[:, ~feet].any()

    def row(
        self, course: Course, robot: Robot, travel_m: float, error_m: float, heading_error_rad: float
    ) -> dict[str, Any]:
        """Distances, errors, and when the plan was made, ready, needed and begun, as plain data."""
        a, first, run = self.ahead, self.plans[0] if self.plans else None, self.simulation
        row = dict(
            jump=self.number + 1,
            asked_m=float(np.hypot(*course.step(self.number)[:2])),
            travel_m=travel_m,
            error_m=error_m,
        )
        row |= dict(rise_m=run.metrics.com_rise_m, air_s=self.air_s, planned_m=a and a.plan.task.distance_m)
        row |= {name: a and getattr(a, name) for name in PLAN_NAMES}
        row |= dict(first_solve_s=first and first.solve_s, first_ready_s=first and first.ready_s)
        row["in_time"] = a.in_time if self.number and a else None
        row |= dict(on_feet=self.on_feet(robot), honest=run.checks_passed, heading_error_rad=heading_error_rad)
        row["plans"] = [{n: getattr(p, n) for n in ("failure", *PLAN_NAMES)} for p in self.plans]
        return row


def _joined(name: str, doc: str) -> property:
    """The logs ``name`` of all jumps of a chain, one after the other."""

    def join(self: ChainResult) -> np.ndarray:
        return np.concatenate([getattr(j.simulation, name) for j in self.jumps])

    return property(join, doc=doc)


@dataclass(frozen=True)
class ChainResult:
    """A finished chain."""

    course: Course
    robot: Robot  # as planned, crouching
    scene: Scene
    jumps: tuple[ChainedJump, ...]  # those that began, and the stand before the first
    interrupted: str  # why the chain ended before its course; empty if it did not
    settings: dict  # how it was run

    @cached_property
    def places_m(self) -> np.ndarray:
        """(K + 1, 3) middle between the toes at first, and at the end of each jump's log, from the first [m].

        On a course with sides and turns the middle between the soles.
        """
        gauge = Gauge(self.robot)
        where = gauge.toe if self.course.in_plane else gauge.soles
        first = where(self.jumps[0].simulation.q[0])
        return np.array([np.zeros(3), *(where(j.simulation.q[-1]) - first for j in self.jumps)])

    @property
    def travels_m(self) -> np.ndarray:
        """(K,) travel of the feet in each jump [m]; with sides and turns the length of the way."""
        if not self.course.in_plane:
            return np.linalg.norm(np.diff(self.places_m[:, :2], axis=0), axis=1)
        return np.diff(self.places_m[:, 0])

    @property
    def errors_m(self) -> np.ndarray:
        """(K,) where the feet stand after each jump less where the course wants them [m]; with sides and turns how far
        off they are."""
        goals = self.course.goals[: len(self.jumps)]
        if not self.course.in_plane:
            return np.linalg.norm(self.places_m[1:, :2] - goals[:, :2], axis=1)
        return self.places_m[1:, 0] - goals[:, 0]

    @property
    def heading_errors_rad(self) -> np.ndarray:
        """(K,) where the feet point after each jump less where the course wants them to [rad]."""
        gauge = Gauge(self.robot)
        found = [gauge.heading(j.simulation.q[-1]) for j in self.jumps]
        off = np.array(found) - gauge.heading(self.jumps[0].simulation.q[0]) - self.course.goals[: len(found), 2]
        return np.arctan2(np.sin(off), np.cos(off))

    @property
    def stood(self) -> bool:
        """Whether every jump was jumped, on the feet alone, and the robot stood for 3 s after the last one."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why the chain counts as failed; empty if it stood."""
        if self.interrupted:
            return self.interrupted
        if len(self.jumps) < self.course.count:
            return f"only {len(self.jumps)} of {self.course.count} jumps began"
        for j, height in zip(self.jumps, self.places_m[1:, 2], strict=True):
            if not j.on_feet(self.robot):
                return f"jump {j.number + 1}: {j.simulation.reason}"
            miss = height - self.course.platforms_m[j.number]
            if abs(miss) > LEVEL_TOLERANCE_M:
                return f"jump {j.number + 1}: stands {miss:+.2f} m from the height it was meant to land on"
            if not j.simulation.checks_passed:
                failed = "; ".join(str(f) for f in j.simulation.checks if not f.passed)
                return f"jump {j.number + 1}: not honest: {failed}"
        last = self.jumps[-1].simulation
        return "" if last.landed else f"jump {len(self.jumps)}: {last.reason}"

    @property
    def replans(self) -> tuple[Ahead, ...]:
        """Plans made on the way, in the air and on the ground: all but the first jump's, for which nothing waits."""
        return tuple(p for j in self.jumps[1:] for p in j.plans)

    @property
    def in_time(self) -> int:
        """How many of the :attr:`replans` were there when the robot was ready for them."""
        return sum(a.in_time for a in self.replans)

    @property
    def waits_s(self) -> tuple[float, ...]:
        """How long the robot, still enough, waited for a plan before each jump but the first [s]."""
        return tuple(j.ahead.began_s - j.ahead.needed_s for j in self.jumps[1:] if j.ahead is not None)

    @property
    def t(self) -> np.ndarray:
        """(N,) time since the chain began [s]."""
        return np.arange(sum(len(j.simulation.t) for j in self.jumps)) * STEP_S

    q = _joined("q", "(N, nq) true configurations.")
    v = _joined("v", "(N, nv) true velocities.")
    tau = _joined("tau", "(N, nv - 6) torques that the motors gave [N m].")
    phase = _joined("phase", '(N,) "launch", "flight" or "landing".')
    com = _joined("com", "(N, 3) CoM of the simulated robot [m].")

    def arrays(self) -> dict[str, np.ndarray]:
        """The log under the names of ``chain.npz``."""
        logs = {name: getattr(self, name) for name in ("t", "q", "v", "tau", "phase", "com")}
        logs["jump"] = np.concatenate([np.full(len(j.simulation.t), j.number) for j in self.jumps])
        return {"schema": np.array(SCHEMA), **logs, "joint_names": np.asarray(self.robot.joint_names)}

    def rows(self) -> list[dict[str, Any]]:
        """One row per jump, see :meth:`ChainedJump.row`."""
        told = zip(
            self.jumps, *(x.tolist() for x in (self.travels_m, self.errors_m, self.heading_errors_rad)), strict=True
        )
        return [jump.row(self.course, self.robot, *row) for jump, *row in told]

    def to_json(self) -> dict[str, Any]:
        """The content of ``chain.json``."""
        robot = dict(name=self.robot.name, hash=self.robot.hash)
        said = dict(schema=SCHEMA, target=asdict(self.course), robot=robot, stood=self.stood, reason=self.reason)
        said |= dict(replans=len(self.replans), in_time=self.in_time, waits_s=self.waits_s, settings=self.settings)
        return said | {"jumps": self.rows()}


def write_chain(
    folder: str | Path, result: ChainResult, further: Mapping[str, str] | None = None, *, series: Mapping | None = None
) -> tuple[AuditReport, ...]:
    """Write a chain, whole or not at all, in the place of an older one; returns the audits of its plans.

    ``jumps/1`` and so on are folders of plans like any other. ``further`` are names and texts of further files (the 3-D
    page); ``series``, a report on many robots, becomes an entry of ``chain.json``.
    """
    audits = []
    with transaction(folder) as staging:
        (staging / JUMPS).mkdir()
        for jump in result.jumps:
            if jump.ahead is not None and jump.ahead.plan is not None:
                plan, place = jump.ahead.plan, staging / JUMPS / str(jump.number + 1)
                audits.append(store.write_plan(place, plan.tape, plan.robot, plan.summary, complete=write_audit))
        np.savez_compressed(staging / LOG, **result.arrays())
        for name, text in (further or {}).items():
            (staging / name).write_text(text, encoding="utf-8")
        report = {**result.to_json(), "versions": store.versions(), **({} if series is None else {"series": series})}
        (staging / REPORT).write_text(store.to_json(report), encoding="utf-8")
    return tuple(audits)
