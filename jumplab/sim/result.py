"""What a simulated jump leaves behind: logs at 1 kHz, and honest numbers made from them."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from jumplab.errors import InputError
from jumplab.io.motion import SIMULATION_SCHEMA as SCHEMA
from jumplab.sim.checks import Finding


@dataclass(frozen=True)
class Metrics:
    """Numbers of one jump, all measured in the simulation; None where the jump did not get so far.

    Attributes
    ----------
    foot_distance_m : travel of the toes from the start to where they stand at the end;
        foot_distance_touchdown_m : to the first touchdown.
    com_rise_m : apex minus CoM at lift-off (last contact force above a few newtons).
    takeoff_velocity : CoM (x, z) there [m/s];  takeoff_momentum : L_y there [kg m^2/s].
    standing_s : from touchdown to the end, or until anything but the feet touched the ground.
    landed, reason : the verdict, and why.
    max_torque_ratio, max_speed_ratio : largest |value| / limit over the run;  ..._before_touchdown : in launch and
        flight only;  ..._by_joint : per joint, over the run.
    saturated_s, overspeed_s : joint -> time at its torque limit, and beyond its speed limit [s]. At touchdown the
        sole's first edge stops within one step, which turns the light foot faster than any motor for some milliseconds.
    self_collision_s : time during which links of the robot pressed on each other [s].
    stray_contacts : links other than the feet that touched ground or platform before touchdown.
    touchdown_trunk_pitch_rad, touchdown_com_velocity : at touchdown [rad], whole turns counted; (x, z) [m/s].
    sole_ahead_m : middle of the soles minus CoM at touchdown.
    launch_impulse, landing_impulse : ground impulse (x, z) until lift-off, and in the 0.1 s after touchdown [N s].
    qp_solves, qp_failures : of the landing controller.
    """

    foot_distance_m: float | None
    foot_distance_touchdown_m: float | None
    com_rise_m: float | None
    takeoff_velocity: tuple[float, float] | None
    takeoff_momentum: float | None
    standing_s: float
    landed: bool
    reason: str
    max_torque_ratio: float
    max_speed_ratio: float
    max_torque_ratio_before_touchdown: float
    max_speed_ratio_before_touchdown: float
    max_torque_ratio_by_joint: dict[str, float]
    max_speed_ratio_by_joint: dict[str, float]
    saturated_s: dict[str, float]
    overspeed_s: dict[str, float]
    self_collision_s: float
    stray_contacts: tuple[str, ...]
    liftoff_s: float | None
    touchdown_s: float | None
    touchdown_trunk_pitch_rad: float | None
    touchdown_com_velocity: tuple[float, float] | None
    sole_ahead_m: float | None
    launch_impulse: tuple[float, float]
    landing_impulse: tuple[float, float] | None
    qp_solves: int
    qp_failures: int


@dataclass(frozen=True)
class SimulationResult:
    """Logs of one simulated jump at 1 kHz, its metrics and its settings.

    Attributes
    ----------
    t : (N,) [s].  Row k holds the state at t[k] and what acted in the step that follows.
    q, v : (N, nq), (N, nv) true state in Pinocchio's conventions.
    tau : (N, nv - 6) torques that the motors really gave [N m].
    foot_wrench : (N, 2, 6) force and moment on each foot, world axes, at the origin of the foot link.
    com, com_velocity : (N, 3) of the simulated (perturbed) robot.
    L : (N,) angular momentum about the pitch axis through the CoM;  rho : (N,) total pitch inertia about it.
    phase : (N,) "launch", "flight" or "landing", by the simulated contact forces.
    touching : (N, links) whether a link pressed on the ground;  link_names : (links,).
    colliding : (N,) whether links of the robot pressed on each other.
    honesty : what :func:`jumplab.sim.checks.check` found.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    foot_wrench: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    L: np.ndarray
    rho: np.ndarray
    phase: np.ndarray
    touching: np.ndarray
    colliding: np.ndarray
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    metrics: Metrics
    settings: dict
    honesty: tuple[Finding, ...] = ()

    @property
    def honest(self) -> bool:
        """True if every check of the run's honesty was made and passed."""
        return bool(self.honesty) and all(finding.passed for finding in self.honesty)

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
        names = ("t", "q", "v", "tau", "foot_wrench", "com", "com_velocity", "L", "rho", "phase", "touching",
                 "colliding", "link_names", "joint_names")  # fmt: skip
        return {"schema": np.array(SCHEMA), **{n: np.asarray(getattr(self, n)) for n in names}}

    def to_json(self) -> dict:
        """Metrics and settings as plain data, the content of ``simulation.json``."""
        return {"schema": SCHEMA, **asdict(self.metrics), "settings": self.settings,
                "honest": self.honest, "honesty": [finding.to_json() for finding in self.honesty]}  # fmt: skip

    def save(self, folder: str | Path, extra: dict | None = None) -> None:
        """Write ``simulation.npz``, then ``simulation.json`` (with ``extra`` entries), each whole or not at all.

        Raises :class:`InputError` if the folder cannot be written.
        """
        folder = Path(folder)
        text = json.dumps({**self.to_json(), **(extra or {})}, indent=2, allow_nan=False) + "\n"
        _write_whole(folder / "simulation.npz", lambda file: np.savez_compressed(file, **self.arrays()))
        _write_whole(folder / "simulation.json", lambda file: file.write(text.encode()))


def _write_whole(path: Path, write) -> None:
    """Write beside ``path`` and move into place, so that no reader ever sees half a file."""
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as e:
        if temporary is not None and os.path.exists(temporary):
            os.remove(temporary)
        raise InputError(f"{path} cannot be written: {e.strerror}; choose a writable folder") from e
