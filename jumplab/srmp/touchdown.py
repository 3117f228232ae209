"""The state in which a landing begins: CoM, velocity and angular momentum right after the feet have met the ground.

The impact is inelastic: both soles stop at once and stay, the joints exert no impulse. What is left of the velocity
follows from the robot's mass matrix alone (no contact stiffness, no time step): of 3.3 m/s downward about a quarter
goes with the feet and shanks, and the angular momentum jumps too. A reference that kept the CoM velocity of the flight
would be ahead of the robot by that much from its first instant on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.optimize import root

from jumplab.errors import InfeasibleError
from jumplab.robot import Robot
from jumplab.robot.stance import com_from_toe, configuration
from jumplab.srmp.plan import SrmpPlan

TRUNK_RAD = 0.15  # our choice: middle of what stage 3 allows at touchdown
KNEE_GUESS_RAD = 1.0  # our choice: start of the search, likewise
POSTURE_TOLERANCE_M = 1e-6  # our choice: far below anything that matters for an impact


@dataclass(frozen=True)
class Touchdown:
    """Whole-body quantities at the start of a landing, sagittal plane.

    Attributes
    ----------
    com, com_velocity : (2,) x and z from the middle between the soles [m, m/s].
    L : angular momentum about the CoM, about +y [kg m^2/s].
    rho : pitch inertia about the CoM [kg m^2].
    trunk_pitch : [rad].
    """

    com: np.ndarray
    com_velocity: np.ndarray
    L: float
    rho: float
    trunk_pitch: float = TRUNK_RAD


def touchdown_of_plan(plan: SrmpPlan, robot: Robot, *, impact: bool = True) -> Touchdown:
    """Touchdown of a stage-1 plan.

    Stage 1 has no posture, so for the impact the legs are bent until the CoM is where the plan has it, feet flat, trunk
    and arms as usual at touchdown; the whole body moves as one with the plan's velocity and angular momentum.

    Parameters
    ----------
    impact : False keeps the velocities of the flight.

    Raises
    ------
    InfeasibleError
        If the legs cannot put the CoM there.
    """
    flight = plan.flight
    com, velocity, momentum, rho = -flight.foot_com[-1], flight.com_velocity[-1], flight.L[-1], float(flight.rho[-1])
    if impact:
        angles = _posture(robot, com)
        q = configuration(robot, angles, toe=-robot.sagittal.sole_center)
        velocity, momentum = _after_impact(robot, q, _rigid_motion(robot, q, velocity, momentum))
    return Touchdown(com, velocity, float(momentum), rho)


def touchdown_of_state(robot: Robot, q: np.ndarray, v: np.ndarray, *, impact: bool = True) -> Touchdown:
    """Touchdown from a state of the full robot, planned or measured.

    Parameters
    ----------
    q, v : (nq,), (nv,) in Pinocchio's conventions.
    impact : True if the soles still move; they are stopped.
    """
    model, data = robot.model, robot.model.createData()
    pin.ccrba(model, data, q, v)
    pin.framesForwardKinematics(model, data, q)
    sole = np.mean([data.oMf[model.getFrameId(n)].act(robot.foot.center) for n in robot.foot.frames], axis=0)
    com, inertia, trunk = data.com[0].copy(), float(data.Ig.inertia[1, 1]), data.oMi[1].rotation
    velocity, momentum = data.hg.linear[[0, 2]] / robot.total_mass, float(data.hg.angular[1])
    if impact:
        velocity, momentum = _after_impact(robot, q, v)
    pitch = float(np.arctan2(trunk[0, 2], trunk[2, 2]))
    return Touchdown((com - sole)[[0, 2]], velocity.copy(), float(momentum), inertia, pitch)


def _posture(robot: Robot, com: np.ndarray) -> np.ndarray:
    """Link angles (5,) with flat feet that put the CoM at ``com`` (2,) from the middle of the sole."""
    model, shoulder = robot.sagittal, robot.stance["shoulder_rad"]

    def angles(legs):
        return np.array([0.0, *legs, TRUNK_RAD, TRUNK_RAD + shoulder])

    def miss(legs):
        return com_from_toe(robot, angles(legs)) - model.sole_center - com

    found = root(miss, [KNEE_GUESS_RAD / 2, -KNEE_GUESS_RAD / 2])
    if not np.max(np.abs(found.fun)) < POSTURE_TOLERANCE_M:
        raise InfeasibleError(
            f"touchdown with the CoM {com[0]:+.3f} m ahead of and {com[1]:.3f} m above the soles: the legs of "
            f"{robot.name} do not reach that; plan with a shorter leg at touchdown"
        )
    return angles(found.x)


def _rigid_motion(robot: Robot, q: np.ndarray, velocity: np.ndarray, momentum: float) -> np.ndarray:
    """Velocity (nv,) of the robot moving as one body with CoM velocity (2,) and angular momentum."""
    model, data = robot.model, robot.model.createData()
    v = np.zeros(model.nv)
    pin.ccrba(model, data, q, v)
    base = pin.XYZQUATToSE3(q[:7])
    spin = np.array([0.0, momentum / data.Ig.inertia[1, 1], 0.0])
    linear = np.array([velocity[0], 0.0, velocity[1]]) + np.cross(spin, base.translation - data.com[0])
    v[:3], v[3:6] = base.rotation.T @ linear, base.rotation.T @ spin
    return v


def _after_impact(robot: Robot, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, float]:
    """CoM velocity (2,) and angular momentum once both feet stand, v+ = v - M^-1 J^T (J M^-1 J^T)^-1 J v."""
    model, data = robot.model, robot.model.createData()
    pin.computeAllTerms(model, data, q, v)
    mass = np.triu(data.M) + np.triu(data.M, 1).T
    frames = [model.getFrameId(n) for n in robot.foot.frames]
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobian = np.vstack([pin.computeFrameJacobian(model, data, q, f, axes) for f in frames])  # (12, nv)
    gain = np.linalg.solve(mass, jacobian.T)  # (nv, 12)
    after = v - gain @ np.linalg.lstsq(jacobian @ gain, jacobian @ v, rcond=1e-9)[0]
    pin.ccrba(model, data, q, after)
    return data.hg.linear[[0, 2]] / robot.total_mass, float(data.hg.angular[1])
