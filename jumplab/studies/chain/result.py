"""A finished chain, and its folder: ``chain.json``, ``chain.npz``, and a plan's folder per jump."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from jumplab.auditing import AuditReport, write_audit
from jumplab.control.kinematics import Gauge
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.sim import STEP_S
from jumplab.sim.result import LEVEL_TOLERANCE_M, SimulationResult
from jumplab.sim.scene import Scene
from jumplab.studies.chain.course import Course
from jumplab.studies.chain.foresight import Ahead
from jumplab.studies.study import Plain

SCHEMA = "jumplab-chain-1"
REPORT = "chain.json"
LOG = "chain.npz"
JUMPS = "jumps"
PLAN_NAMES = "looked_s air place_m solve_s cpu_s ready_s needed_s began_s".split()


@dataclass(frozen=True)
class ChainedJump:
    """One jump of a chain."""

    number: int  # from 0
    # time of the chain at which the log begins; the stand before the first jump belongs to it
    start_s: float
    ahead: Ahead | None  # the plan with which it began; None if it did not
    plans: tuple[Ahead, ...]  # all that were made for it
    # log up to the beginning of the next jump, its time counted from zero
    simulation: SimulationResult

    @property
    def air_s(self) -> float | None:
        """Time between lift-off and touchdown [s]; None if there was no touchdown."""
        m = self.simulation.metrics
        return None if m.touchdown_s is None or m.liftoff_s is None else m.touchdown_s - m.liftoff_s

    def on_feet(self, robot: Robot) -> bool:
        """Whether it came down, and nothing but the feet (of ``robot``) touched the ground from its
        start to the next jump.
        """
        feet = np.isin(self.simulation.link_names, robot.foot.frames)
        return self.air_s is not None and not self.simulation.touching[:, ~feet].any()


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
    def feet(self) -> np.ndarray:
        """(K + 1, 4) x, y, z [m] and heading [rad] of the feet, at first and where each jump's log
        ends, from the first; of the toes, or on a course with sides and turns of the soles' middle.
        """
        gauge = Gauge(self.robot)
        where = gauge.toe if self.course.in_plane else gauge.soles
        ends = [self.jumps[0].simulation.q[0], *(j.simulation.q[-1] for j in self.jumps)]
        poses = np.array([[*where(q), gauge.heading(q)] for q in ends])
        return poses - poses[0]

    @property
    def places_m(self) -> np.ndarray:
        """(K + 1, 3) places of the :attr:`feet` [m]."""
        return self.feet[:, :3]

    @property
    def travels_m(self) -> np.ndarray:
        """(K,) travel of the feet in each jump [m]; with sides and turns the length of the way."""
        return self._along(np.diff(self.feet, axis=0))

    @property
    def errors_m(self) -> np.ndarray:
        """(K,) places of the feet after each jump less those of the course [m]; with
        sides and turns how far off they are.
        """
        return self._along(self.feet[1:, :2] - self.course.goals[: len(self.jumps), :2])

    def _along(self, ways: np.ndarray) -> np.ndarray:
        return ways[:, 0] if self.course.in_plane else np.linalg.norm(ways[:, :2], axis=1)

    @property
    def heading_errors_rad(self) -> np.ndarray:
        """(K,) headings of the feet after each jump less those of the course [rad]."""
        errors = self.feet[1:, 3] - self.course.goals[: len(self.jumps), 2]
        return np.arctan2(np.sin(errors), np.cos(errors))

    @property
    def stood(self) -> bool:
        """Whether every jump was jumped, on the feet alone, and the robot stood for 3 s after the
        last one.
        """
        return not self.reason

    @property
    def reason(self) -> str:
        """Reason why the chain counts as failed; empty if it stood."""
        if self.interrupted:
            return self.interrupted
        if len(self.jumps) < self.course.count:
            return f"only {len(self.jumps)} of {self.course.count} jumps began"
        for jump, top in zip(self.jumps, self.course.platforms_m, strict=True):
            run = jump.simulation
            miss = self.feet[jump.number + 1, 2] - top
            reason = ""
            if not jump.on_feet(self.robot):
                reason = run.reason
            elif abs(miss) > LEVEL_TOLERANCE_M:
                reason = f"stands {miss:+.2f} m from the height it was meant to land on"
            elif not run.checks_passed:
                checks = "; ".join(str(f) for f in run.checks if not f.passed)
                reason = f"failed checks of the run: {checks}"
            elif jump is self.jumps[-1] and not run.landed:
                reason = run.reason
            if reason:
                return f"jump {jump.number + 1}: {reason}"
        return ""

    @property
    def replans(self) -> tuple[Ahead, ...]:
        """Plans made on the way, in the air and on the ground: all but the first jump's, for which
        nothing waits.
        """
        return tuple(p for j in self.jumps[1:] for p in j.plans)

    @property
    def in_time(self) -> int:
        """Number of the :attr:`replans` that were there when the robot was ready for them."""
        return sum(a.in_time for a in self.replans)

    @property
    def waits_s(self) -> tuple[float, ...]:
        """Waits of the robot, still enough, for a plan before each jump but the first [s]."""
        begun = (j.ahead for j in self.jumps[1:] if j.ahead)
        return tuple(ahead.began_s - ahead.needed_s for ahead in begun)

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
        return logs | {"schema": np.array(SCHEMA), "joint_names": np.array(self.robot.joint_names)}

    def rows(self) -> list[Plain]:
        """One row per jump: distances [m], errors, and when the plan was made, ready, needed and
        begun [s].
        """
        rows = []
        for jump in self.jumps:
            ahead = jump.ahead
            task = self.course.tasks[jump.number]
            row = {
                "jump": jump.number + 1,
                "asked_m": math.hypot(task.distance_m, task.side_m),
                "travel_m": float(self.travels_m[jump.number]),
                "error_m": float(self.errors_m[jump.number]),
                "heading_error_rad": float(self.heading_errors_rad[jump.number]),
                "rise_m": jump.simulation.metrics.com_rise_m,
                "air_s": jump.air_s,
                "planned_m": ahead and ahead.plan.task.distance_m,
                **{name: ahead and getattr(ahead, name) for name in PLAN_NAMES},
                "in_time": ahead.in_time if jump.number and ahead else None,
                "on_feet": jump.on_feet(self.robot),
                "checks_passed": jump.simulation.checks_passed,
                "plans": [{n: getattr(p, n) for n in ("failure", *PLAN_NAMES)} for p in jump.plans],
            }
            rows.append(row)
        return rows

    def to_json(self) -> Plain:
        """The content of ``chain.json``."""
        return {
            "schema": SCHEMA,
            "target": self.course.to_json(),
            "robot": {"name": self.robot.name, "hash": self.robot.hash},
            "stood": self.stood,
            "reason": self.reason,
            "replans": len(self.replans),
            "in_time": self.in_time,
            "waits_s": self.waits_s,
            "settings": self.settings,
            "jumps": self.rows(),
        }


def write_chain(
    folder: str | Path,
    result: ChainResult,
    further: Mapping[str, str] | None = None,
    *,
    series: Mapping | None = None,
) -> tuple[AuditReport, ...]:
    """Write a chain, whole or not at all, in the place of an older one; returns the audits of its
    plans.

    ``jumps/1`` and so on are folders of plans like any other. ``further`` are names and texts of
    further files (the 3-D page); ``series``, a report on many robots, becomes an entry of
    ``chain.json``.
    """
    audits = []
    with store.transaction(folder) as staging:
        (staging / JUMPS).mkdir()
        for jump in result.jumps:
            if jump.ahead is not None:
                plan = jump.ahead.plan
                place = staging / JUMPS / str(jump.number + 1)
                given = place, plan.tape, plan.robot, plan.summary
                audits.append(store.write_plan(*given, complete=write_audit))
        np.savez_compressed(staging / LOG, **result.arrays())
        for name, text in (further or {}).items():
            (staging / name).write_text(text, encoding="utf-8")
        report = result.to_json() | {"versions": store.versions()}
        if series is not None:
            report["series"] = series
        (staging / REPORT).write_text(store.to_json(report), encoding="utf-8")
    return tuple(audits)
