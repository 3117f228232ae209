"""What a simulated jump leaves behind: logs at 1 kHz, numbers measured from them, and what its checks found."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from jumplab.errors import InputError
from jumplab.io.files import write_file
from jumplab.io.folder import read_json
from jumplab.io.motion import SIMULATION_NAME, SIMULATION_SCHEMA, read_simulation
from jumplab.robot import Robot

STAND_S = 3.0  # [s] standing this long after touchdown, and not a moment less, is a landing
REPORT_NAME = "simulation.json"


@dataclass(frozen=True)
class Finding:
    """One question about a run, answered: ``value`` may not exceed ``limit`` [unit]."""

    name: str
    value: float
    limit: float
    unit: str
    catches: str

    @property
    def passed(self) -> bool:
        """True if the value is within its limit."""
        return bool(self.value <= self.limit)

    def to_json(self) -> dict:
        """Plain data."""
        return {**asdict(self), "value": float(self.value), "passed": self.passed}

    def __str__(self) -> str:
        return f"{self.name}: {self.value:.4g} {self.unit}".rstrip() + f" (at most {self.limit:.4g}; {self.catches})"


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Numbers of one jump, all measured in the simulation; None where the jump did not get so far.

    Loads are ratios |value| / limit, largest over the run; vectors are (x, z).
    """

    foot_distance_m: float | None = None  # travel of the toes from the start to where they stand at the end
    foot_distance_touchdown_m: float | None = None  # the same, to the first touchdown
    com_rise_m: float | None = None  # apex minus CoM at lift-off, the last contact force above a few newtons
    takeoff_velocity: tuple[float, float] | None = None  # of the CoM at lift-off [m/s]
    takeoff_momentum: float | None = None  # L_y at lift-off [kg m^2/s]
    standing_s: float  # from touchdown to the end, or until anything but the feet touched the ground
    landed: bool
    reason: str  # of that verdict
    max_torque_ratio: float
    max_speed_ratio: float
    max_torque_ratio_before_touchdown: float
    max_speed_ratio_before_touchdown: float
    max_torque_ratio_by_joint: dict[str, float]
    max_speed_ratio_by_joint: dict[str, float]
    saturated_s: dict[str, float]  # by joint: time at its torque limit
    overspeed_s: dict[str, float]  # by joint: beyond its speed limit; a light foot for milliseconds at touchdown
    self_collision_s: float  # time during which links of the robot pressed on each other
    stray_contacts: tuple[str, ...]  # links other than the feet that touched the ground before touchdown
    liftoff_s: float | None = None
    touchdown_s: float | None = None
    touchdown_trunk_pitch_rad: float | None = None  # whole turns counted
    touchdown_com_velocity: tuple[float, float] | None = None  # [m/s]
    sole_ahead_m: float | None = None  # middle of the soles minus CoM at touchdown
    launch_impulse: tuple[float, float]  # of the ground until lift-off [N s]
    landing_impulse: tuple[float, float] | None = None  # of the ground in the 0.1 s after touchdown [N s]
    qp_solves: int  # of the landing controller
    qp_failures: int


@dataclass(frozen=True)
class SimulationResult:
    """Logs of one simulated jump at 1 kHz, its metrics and its settings.

    Row k holds the state at t[k] and what acted in the step that follows.
    """

    t: np.ndarray  # (N,) [s]
    q: np.ndarray  # (N, nq) true configuration in Pinocchio's conventions
    v: np.ndarray  # (N, nv) true velocity
    tau: np.ndarray  # (N, nv - 6) torques that the motors really gave [N m]
    foot_wrench: np.ndarray  # (N, 2, 6) force and moment on each foot, world axes, at the origin of the foot link
    com: np.ndarray  # (N, 3) of the simulated (perturbed) robot [m]
    com_velocity: np.ndarray  # (N, 3) [m/s]
    L: np.ndarray  # (N,) angular momentum about the pitch axis through the CoM [kg m^2/s]
    rho: np.ndarray  # (N,) total pitch inertia about the CoM [kg m^2]
    phase: np.ndarray  # (N,) "launch", "flight" or "landing", by the simulated contact forces
    touching: np.ndarray  # (N, links) whether a link pressed on the ground
    colliding: np.ndarray  # (N,) whether links of the robot pressed on each other
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    metrics: Metrics
    settings: dict
    checks: tuple[Finding, ...] = ()  # of jumplab.sim.checks.check

    @property
    def checks_passed(self) -> bool:
        """True if the run was checked, and every check passed."""
        return bool(self.checks) and all(finding.passed for finding in self.checks)

    @property
    def landed(self) -> bool:
        """True if the robot stood on its feet until the end."""
        return self.metrics.landed

    @property
    def reason(self) -> str:
        """Why the verdict is what it is."""
        return self.metrics.reason

    def arrays(self) -> dict[str, np.ndarray]:
        """All logs under the names of ``simulation.npz``."""
        return {"schema": np.array(SIMULATION_SCHEMA), **{name: np.asarray(getattr(self, name)) for name in LOGS}}

    def to_json(self) -> dict:
        """Metrics, settings and findings as plain data, the content of ``simulation.json``."""
        findings = [finding.to_json() for finding in self.checks]
        said = {"settings": self.settings, "honest": self.checks_passed, "honesty": findings}
        return {"schema": SIMULATION_SCHEMA, **asdict(self.metrics), **said}

    def save(self, folder: str | Path, extra: dict | None = None) -> None:
        """Write ``simulation.npz``, then ``simulation.json`` (with ``extra`` entries), each whole or not at all.

        Raises :class:`InputError` if the folder cannot be written.
        """
        text = json.dumps({**self.to_json(), **(extra or {})}, indent=2, allow_nan=False) + "\n"
        np.savez_compressed(logs := io.BytesIO(), **self.arrays())
        write_file(Path(folder) / SIMULATION_NAME, logs.getvalue())
        write_file(Path(folder) / REPORT_NAME, text.encode())

    @classmethod
    def load(cls, folder: str | Path, robot: Robot) -> SimulationResult | None:
        """What :meth:`save` wrote into ``folder``; None if it holds no simulation.

        Raises
        ------
        InputError
            If a file is damaged, or the simulation is not one of ``robot``.
        """
        if not (Path(folder) / SIMULATION_NAME).is_file():
            return None
        logs, said = read_simulation(folder, robot, LOGS), read_json(Path(folder) / REPORT_NAME)
        try:
            names = {name: tuple(logs.pop(name).tolist()) for name in ("link_names", "joint_names")}
            if {len(log) for log in logs.values()} != {logs["t"].size}:
                raise ValueError("logs of different lengths")
            numbers = {f.name: said[f.name] for f in fields(Metrics)}
            metrics = Metrics(**{k: tuple(x) if isinstance(x, list) else x for k, x in numbers.items()})
            findings = tuple(Finding(*(row[f.name] for f in fields(Finding))) for row in said["honesty"])
            settings = dict(said["settings"])
        except (KeyError, TypeError, ValueError) as e:
            why = type(e).__name__
            raise InputError(f"{folder}: not a readable simulation ({why}); simulate the plan again") from e
        for array in logs.values():
            array.setflags(write=False)
        return cls(**logs, **names, metrics=metrics, settings=settings, checks=findings)


LOGS = tuple(f.name for f in fields(SimulationResult) if f.name not in ("metrics", "settings", "checks"))
