"""A chain's result folder, written whole or not at all: ``chain.json``, ``chain.npz``, and a plan's folder per jump."""

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
from jumplab.sim.recorder import LEVEL_TOLERANCE_M
from jumplab.sim.result import SimulationResult
from jumplab.sim.scene import Scene
from jumplab.sim.world import STEP_S
from jumplab.studies.chain.course import Course, Gauge
from jumplab.studies.chain.foresight import Ahead

# result ------------------------------------------------------------------------------------------
SCHEMA = "jumplab-chain-1"
PLAN_NAMES = (
    "looked_s",
    "air",
    "foretold_m",
    "place_m",
    "bias_m",
    "solve_s",
    "cpu_s",
    "ready_s",
    "needed_s",
    "began_s",
)


@dataclass(frozen=True)
class ChainedJump:
    """One jump of a chain.

    Attributes
    ----------
    number : from 0.
    start_s : time of the chain at which ``simulation`` begins [s]; the stand before the first jump belongs to it.
    ahead : the plan with which it began; None if it did not.  plans : all that were made for it.
    simulation : log from there to the beginning of the next jump, its time counted from zero.
    """

    number: int
    start_s: float
    ahead: Ahead | None
    plans: tuple[Ahead, ...]
    simulation: SimulationResult

    @property
    def air_s(self) -> float | None:
        """Time between lift-off and touchdown [s]; None if there was no touchdown."""
        m = self.simulation.metrics
        return None if m.touchdown_s is None or m.liftoff_s is None else m.touchdown_s - m.liftoff_s

    def on_feet(self, robot: Robot) -> bool:
        """Whether it came down, and nothing but the feet touched the ground from its start to the next jump."""
        feet = np.isin(self.simulation.link_names, robot.foot.frames)
        return self.air_s is not None and not self.simulation.touching[:, ~feet].any()


@dataclass(frozen=True)
class ChainResult:
    """A finished chain.

    Attributes
    ----------
    course, robot, scene : what was asked, of whom (crouching), on which ground.
    jumps : those that began, and the stand before the first.
    interrupted : why the chain ended before its course; empty if it did not.
    settings : how it was run.
    """

    course: Course
    robot: Robot
    scene: Scene
    jumps: tuple[ChainedJump, ...]
    interrupted: str
    settings: dict

    # places ----------------------------------------------------------------------------------------------------

    @cached_property
    def places_m(self) -> np.ndarray:
        """(K + 1, 3) middle between the toes before the first jump and after each one, from the first [m].

        "After" is the end of the jump's log: the last step before the next jump, or of all.
        """
        gauge = Gauge(self.robot)
        first = gauge.toe(self.jumps[0].simulation.q[0])
        return np.array([np.zeros(3), *(gauge.toe(j.simulation.q[-1]) - first for j in self.jumps)])

    @property
    def travels_m(self) -> np.ndarray:
        """(K,) travel of the feet in each jump [m]."""
        return np.diff(self.places_m[:, 0])

    @property
    def errors_m(self) -> np.ndarray:
        """(K,) distance error of each jump: where the toes stand after it less where the course wants them [m].

        That is its travel less the way from where it really began to its goal: a jump that makes good what the one
        before has missed travels more or less than the course says, and is right to.
        """
        return self.places_m[1:, 0] - np.array(self.course.goals_m[: len(self.jumps)])

    # verdicts --------------------------------------------------------------------------------------------------

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
            if not j.simulation.honest:
                return f"jump {j.number + 1}: not honest: " + "; ".join(
                    str(f) for f in j.simulation.honesty if not f.passed)  # fmt: skip
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

    # the whole log ---------------------------------------------------------------------------------------------

    def _joined(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(j.simulation, name) for j in self.jumps])

    @property
    def t(self) -> np.ndarray:
        """(N,) time since the chain began [s]."""
        return np.arange(sum(len(j.simulation.t) for j in self.jumps)) * STEP_S

    @property
    def q(self) -> np.ndarray:
        """(N, nq) true configurations."""
        return self._joined("q")

    @property
    def v(self) -> np.ndarray:
        """(N, nv) true velocities."""
        return self._joined("v")

    @property
    def tau(self) -> np.ndarray:
        """(N, nv - 6) torques that the motors gave [N m]."""
        return self._joined("tau")

    @property
    def phase(self) -> np.ndarray:
        """(N,) "launch", "flight" or "landing"."""
        return self._joined("phase")

    @property
    def com(self) -> np.ndarray:
        """(N, 3) CoM of the simulated robot [m]."""
        return self._joined("com")

    def arrays(self) -> dict[str, np.ndarray]:
        """The log under the names of ``chain.npz``."""
        logs = {name: getattr(self, name) for name in ("t", "q", "v", "tau", "phase", "com")}
        return {"schema": np.array(SCHEMA), **logs, "jump": np.concatenate(
            [np.full(len(j.simulation.t), j.number) for j in self.jumps]),
            "joint_names": np.asarray(self.robot.joint_names)}  # fmt: skip

    def rows(self) -> list[dict[str, Any]]:
        """One row per jump: distances, errors, and when its plan was made, ready, needed and begun."""
        out = []
        for j, travel, error in zip(self.jumps, self.travels_m, self.errors_m, strict=True):
            a, m = j.ahead, j.simulation.metrics
            told = {name: None if a is None else getattr(a, name) for name in PLAN_NAMES}
            first = j.plans[0] if j.plans else None
            out.append({
                "jump": j.number + 1, "asked_m": self.course.distances_m[j.number],
                "planned_m": None if a is None else a.plan.task.distance_m, "travel_m": float(travel),
                "error_m": float(error), "rise_m": m.com_rise_m, "air_s": j.air_s, **told,
                "first_solve_s": first and first.solve_s, "first_ready_s": first and first.ready_s,
                "in_time": None if not j.number or a is None else a.in_time,
                "on_feet": j.on_feet(self.robot), "honest": j.simulation.honest,
                "plans": [{"failure": p.failure, **{name: getattr(p, name) for name in PLAN_NAMES}} for p in j.plans],
            })  # fmt: skip
        return out

    def to_json(self) -> dict[str, Any]:
        """The content of ``chain.json``."""
        return {
            "schema": SCHEMA, "target": asdict(self.course),
            "robot": {"name": self.robot.name, "hash": self.robot.hash}, "stood": self.stood, "reason": self.reason,
            "replans": len(self.replans), "in_time": self.in_time, "waits_s": self.waits_s,
            "jumps": self.rows(), "settings": self.settings,
        }  # fmt: skip


# folder ------------------------------------------------------------------------------------------
REPORT, LOG, JUMPS = "chain.json", "chain.npz", "jumps"


def write_chain(folder: str | Path, result: ChainResult, further: Mapping[str, str] | None = None, *,
                series: Mapping | None = None) -> tuple[AuditReport, ...]:  # fmt: skip
    """Write a chain; what an older chain left there goes.

    ``jumps/1``, ``jumps/2`` and so on are folders of plans like any other, which ``jumplab audit`` and others read.

    Parameters
    ----------
    further : names and texts of further files (the 3-D page).
    series : a report on many robots, becomes the entry ``series`` of ``chain.json``.

    Returns
    -------
    The audits of the plans, in the order of the jumps; they lie beside the plans as ``passport.json``.
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
