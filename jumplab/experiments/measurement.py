"""What a laboratory could know of a jump: computed from simulated, noisy sensors with the planned robot's model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from jumplab.robot import Robot
from jumplab.simulation import SensorNoise, SimulationResult


@dataclass(frozen=True)
class Measurement:
    """A jump as its sensors tell it, up to touchdown.

    Attributes
    ----------
    t : (N,) [s].
    phase : (N,) "launch" or "flight".
    com : (N, 2) x and z [m], with the toes standing where they started; nan in flight, where no sensor tells it.
    L : (N,) angular momentum about the pitch axis [kg m^2/s].
    rho : (N,) pitch inertia about the CoM [kg m^2].
    """

    t: np.ndarray
    phase: np.ndarray
    com: np.ndarray
    L: np.ndarray
    rho: np.ndarray


def measure(result: SimulationResult, robot: Robot, noise: SensorNoise | None = None, seed: int = 0) -> Measurement:
    """Read the sensors of a simulated jump: encoders, and the trunk's tilt and gyro, each with white noise.

    Neither L nor rho needs to know where the robot is or how fast it travels. The CoM is found from the toes, which
    stand still until take-off.

    Parameters
    ----------
    result : the simulated jump.
    robot : the robot as planned: all that a laboratory has for a model.
    noise : :meth:`SensorNoise.typical` if None.
    seed : of the noise.
    """
    noise, rng = SensorNoise.typical() if noise is None else noise, np.random.default_rng(seed)
    seen = result.phase != "landing"
    model, data = robot.model, robot.model.createData()
    toe = np.array([robot.foot.toe, 0.0, robot.foot.sole_z])
    frames = [model.getFrameId(name) for name in robot.foot.frames]  # names checked by Robot
    start, rows = None, []
    for true_q, true_v in zip(result.q[seen], result.v[seen], strict=True):
        q, v = _read(true_q, true_v, noise, rng)
        pin.ccrba(model, data, q, v)
        pin.updateFramePlacements(model, data)
        toes = np.mean([data.oMf[frame].act(toe) for frame in frames], axis=0)
        if start is None:  # where the robot was put is known
            pin.framesForwardKinematics(model, data, true_q)
            start = np.mean([data.oMf[frame].act(toe) for frame in frames], axis=0)
        place = data.com[0] - toes + start
        rows.append((place[0], place[2], data.hg.angular[1], data.Ig.inertia[1, 1]))
    rows, phase = np.array(rows), result.phase[seen]
    com = np.where((phase == "launch")[:, None], rows[:, :2], np.nan)
    return Measurement(result.t[seen], phase, com, rows[:, 2], rows[:, 3])


def _read(q: np.ndarray, v: np.ndarray, noise: SensorNoise, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Configuration and velocity as encoders, tilt and gyro tell them; place and speed of the base are nobody's."""
    q, v, joints = q.copy(), v.copy(), len(q) - 7
    turn = pin.Quaternion(pin.exp3(noise.tilt_rad * rng.standard_normal(3)))
    q[3:7] = (pin.Quaternion(q[6], q[3], q[4], q[5]) * turn).coeffs()
    q[7:] += noise.joint_rad * rng.standard_normal(joints)
    q[:3] = v[:3] = 0.0
    v[3:6] += noise.gyro * rng.standard_normal(3)
    v[6:] += noise.joint_rate * rng.standard_normal(joints)
    return q, v
