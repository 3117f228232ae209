"""What stage 1 publishes: sampled launch and flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.robot.reach import Reach
from jumplab.solver import Solution
from jumplab.task import JumpTask


@dataclass(frozen=True)
class SrmpLaunch:
    """Stage 1's launch on a fixed grid; positions from the pivot, the middle of the sole at its initial place.

    t (n,) [s]; com, com_velocity, com_acceleration (n, 2) [m ...]; L [kg m^2/s]; L_rate [N m]; rho [kg m^2] with rate
    and accel; F_x, F_z [N]; cop_x [m]; lean, posture (theta_l + theta_pl) [rad]; coordinates (n, 4).
    """

    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    L: np.ndarray
    L_rate: np.ndarray
    rho: np.ndarray
    rho_rate: np.ndarray
    rho_accel: np.ndarray
    F_x: np.ndarray
    F_z: np.ndarray
    cop_x: np.ndarray
    lean: np.ndarray
    posture: np.ndarray
    coordinates: np.ndarray


@dataclass(frozen=True)
class SrmpFlight:
    """Stage 1's flight on a fixed grid, t from take-off: as :class:`SrmpLaunch`, L constant.

    lean : angle of the line from foot to CoM against the vertical [rad] (theta_l of the flight);
    foot_com : middle of the sole relative to the CoM (n, 2) [m], with rate and acceleration.
    """

    t: np.ndarray
    com: np.ndarray
    com_velocity: np.ndarray
    com_acceleration: np.ndarray
    L: np.ndarray
    rho: np.ndarray
    rho_rate: np.ndarray
    rho_accel: np.ndarray
    lean: np.ndarray
    foot_com: np.ndarray
    foot_com_rate: np.ndarray
    foot_com_accel: np.ndarray


@dataclass(frozen=True)
class SrmpPlan:
    """Result of stage 1: sampled launch and flight, the solution itself, the envelope it was kept in, the target."""

    task: JumpTask
    launch: SrmpLaunch
    flight: SrmpFlight
    solution: Solution
    reach: Reach
    touchdown_length_m: float

    @property
    def launch_s(self) -> float:
        """Duration of the launch [s]."""
        return float(self.launch.t[-1])

    @property
    def toe_s(self) -> float:
        """Duration of the launch's last part, heel up and CoP at the toe [s]."""
        return self.solution.phases["toe"].duration

    @property
    def flight_s(self) -> float:
        """Duration of the flight [s]."""
        return float(self.flight.t[-1])
