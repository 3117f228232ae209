"""One trial of many: a robot drawn by seed and number, its jump, and the line that is kept of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from jumplab import store
from jumplab.errors import InputError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.simulation import Metrics, Perturbation, Ranges, Scene, SensorNoise, SimulationResult, simulate_jump
from jumplab.simulation.playback import MODES
from jumplab.trajectory import Tape

SCHEMA = "jumplab-trials-1"
SHAPING = ("jumplab", "casadi", "numpy", "pin", "proxsuite", "pybullet")  # whose versions decide a trial's outcome
LOOKING = ("commands", "notebooks.py", "plotting", "viewer")  # rooms of the package that decide nothing about a jump
HASH_DIGITS = 16  # 64 bits: enough to tell settings apart
LEG_ROLES = ("hip_pitch", "knee", "ankle_pitch")


@dataclass(frozen=True)
class TrialSettings:
    """How the robots of a Monte Carlo are drawn and made to jump.

    Attributes
    ----------
    mode : "position" or "pd", how the tape is played until touchdown.
    reaim : turn the legs in the air against the trunk's measured pitch error.
    noise : on what the controllers are told.
    ranges : half-widths of the draws.
    """

    mode: str = "position"
    reaim: bool = True
    noise: SensorNoise = field(default_factory=SensorNoise)
    ranges: Ranges = field(default_factory=Ranges)

    def __post_init__(self):
        if self.mode not in MODES:
            raise InputError(f"mode {self.mode!r}: must be one of {', '.join(MODES)}")

    @property
    def hash(self) -> str:
        """Short hash of these settings, of the package's own code and of the packages that shape an outcome."""
        known = store.versions()
        return _hash([SCHEMA, asdict(self), _code(), {name: known[name] for name in SHAPING}])


@dataclass(frozen=True)
class TrialKey:
    """What decides a trial's outcome, bit for bit: equal keys, equal trials."""

    seed: int
    index: int
    settings: str
    plan: str

    @property
    def robot_seed(self) -> int:
        """Seed of this trial's robot and of its sensor noise."""
        return int(np.random.SeedSequence([self.seed, self.index]).generate_state(1)[0])


@dataclass(frozen=True)
class Trial:
    """One finished trial.

    Attributes
    ----------
    key : what it was.
    perturbation : every drawn number, as :meth:`jumplab.simulation.Perturbation.to_json` gives them.
    features : the drawn robot in a few numbers, see :func:`features`.
    landed, reason : the verdict, and why; a run that fails a check of its honesty has not landed.
    metrics : all numbers of the jump; None if the engine lost the robot.
    """

    key: TrialKey
    perturbation: dict[str, Any]
    features: dict[str, float]
    landed: bool
    reason: str
    metrics: Metrics | None

    def line(self) -> str:
        """The trial as one line of JSON, newline included."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, allow_nan=False) + "\n"

    @classmethod
    def from_line(cls, line: str | bytes) -> Trial:
        """Inverse of :meth:`line`; raises ValueError, KeyError or TypeError if the line is damaged or not ours."""
        data = json.loads(line)
        if data.pop("schema") != SCHEMA:
            raise ValueError("another schema")
        metrics = data.pop("metrics")
        if metrics is not None:
            metrics = Metrics(**{k: tuple(v) if isinstance(v, list) else v for k, v in metrics.items()})
        return cls(key=TrialKey(**data.pop("key")), metrics=metrics, **data)


def run_trial(tape: Tape, robot: Robot, scene: Scene, settings: TrialSettings, key: TrialKey) -> Trial:
    """Draw the robot of ``key`` and let it jump.

    Raises
    ------
    InputError
        If the tape is not this robot's.
    """
    drawn = Perturbation.draw(robot, key.robot_seed, settings.ranges, settings.noise)
    verdict = judged(lambda: simulate_jump(
        tape, robot, mode=settings.mode, perturbation=drawn, scene=scene, reaim=settings.reaim))  # fmt: skip
    trial = Trial(key, drawn.to_json(), features(drawn, robot), *verdict)
    return Trial.from_line(trial.line())  # the very thing that a resumed run reads


def judged(simulate: Callable[[], SimulationResult]) -> tuple[bool, str, Metrics | None]:
    """Whether a jump counts as landed, why (not), and its metrics: a run that fails a check of its honesty does not."""
    try:
        result = simulate()
    except SolverError as e:  # the engine lost the robot: a failure like any other, and counted as one
        return False, str(e), None
    doubts = [str(finding) for finding in result.honesty if not finding.passed]
    if result.honest:
        return result.landed, result.reason, result.metrics
    doubts = "; ".join(doubts) or "nothing was checked"
    return False, f"not honest: {doubts}; the run's own verdict: {result.reason}", result.metrics


def features(drawn: Perturbation, robot: Robot) -> dict[str, float]:
    """A perturbed robot in a few numbers, all relative to the planned one.

    Returns
    -------
    friction [1], delay_s [s], mass [1] (whole robot), com_x_m and com_y_m [m] (whole robot, in its stance),
    leg_motors [1] (mean gain of hip, knee and ankle pitch motors, minus 1).
    """
    q, real = stance_configuration(robot), drawn.robot(robot)
    shift = _com(real, q) - _com(robot, q)
    legs = [drawn.motor_gain.get(name, 1.0) for role in LEG_ROLES for name in robot.joints[role]]
    return {
        "friction": drawn.friction,
        "delay_s": drawn.delay_s,
        "mass": real.total_mass / robot.total_mass - 1,
        "com_x_m": float(shift[0]),
        "com_y_m": float(shift[1]),
        "leg_motors": float(np.mean(legs)) - 1,
    }


def plan_hash(summary: Mapping[str, Any]) -> str:
    """Short hash of all that a trial takes from a plan's folder: tape, robot, ground."""
    return _hash([summary["manifest"]["files"], summary["target"], summary.get("platform_edge_m")])


def _com(robot: Robot, q: np.ndarray) -> np.ndarray:
    return pin.centerOfMass(robot.model, robot.model.createData(), q, False).copy()


def _code() -> str:
    """Hash of the package's source: trials of other code are not these trials."""
    root = Path(store.__file__).parent
    files = sorted(f for f in root.rglob("*.py") if f.relative_to(root).parts[0] not in LOOKING)
    return _hash([[str(f.relative_to(root)), hashlib.sha256(f.read_bytes()).hexdigest()] for f in files])


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:HASH_DIGITS]
