"""Measurements of a jump in a laboratory: estimates from simulated, noisy sensors with the planned robot's model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.control import Estimator, SensorNoise
from jumplab.robot import Robot
from jumplab.sim import SimulationResult
from jumplab.sim.sensors import Sensors


@dataclass(frozen=True)
class Measurement:
    """A jump as its sensors measure it, up to touchdown.

    Attributes
    ----------
    t : (N,) [s].
    phase : (N,) "launch" or "flight".
    com : (N, 2) x and z [m], from where the robot was put; in flight by the inertial unit alone.
    L : (N,) angular momentum about the pitch axis [kg m^2/s].
    rho : (N,) pitch inertia about the CoM [kg m^2].
    """

    t: np.ndarray
    phase: np.ndarray
    com: np.ndarray
    L: np.ndarray
    rho: np.ndarray


def measure(result: SimulationResult, robot: Robot, noise: SensorNoise | None = None, seed: int = 0) -> Measurement:
    """Read the sensors of a simulated jump, and estimate its state as the robot itself would.

    Encoders, inertial unit and foot forces go through :class:`jumplab.control.Estimator`; CoM, L and rho are those
    of the planned robot in the estimated state.

    Parameters
    ----------
    result : the simulated jump.
    robot : the robot as planned: all that a laboratory has for a model.
    noise : :meth:`SensorNoise.typical` if None.
    seed : of the noise.
    """
    sensors = Sensors(SensorNoise.typical() if noise is None else noise, seed)
    estimator = Estimator(robot, sensors.initial(result.q[0]), result.v[0], sensors.noise)
    felt = np.concatenate([result.foot_wrench[:1], result.foot_wrench[:-1]])  # row k of the log acts after t[k]
    model, data = robot.model, robot.model.createData()
    seen, rows = result.phase != "landing", []
    for q, v, wrench in zip(result.q[seen], result.v[seen], felt[seen], strict=True):
        pin.ccrba(model, data, *estimator.update(sensors.read(q, v, wrench)))
        rows.append((data.com[0][0], data.com[0][2], data.hg.angular[1], data.Ig.inertia[1, 1]))
    rows = np.array(rows)
    return Measurement(result.t[seen], result.phase[seen], rows[:, :2], rows[:, 2], rows[:, 3])
