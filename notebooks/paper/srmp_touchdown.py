"""Touchdown of a plan of stage 1 alone, which has no posture: what a landing right behind stage 1 begins with."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.optimize import root

from jumplab.errors import InfeasibleError
from jumplab.models.full import FullBody
from jumplab.robot import Robot
from jumplab.robot.stance import com_from_toe, configuration
from jumplab.stages.srmp import SrmpPlan
from jumplab.stages.srmp.landing import Touchdown, after_impact

TRUNK_RAD = 0.15  # middle of what stage 3 allows at touchdown
KNEE_GUESS_RAD = 1.0  # start of the search, as stage 3's
POSTURE_TOLERANCE_M = 1e-6  # far below anything that matters for an impact


def touchdown_of_plan(plan: SrmpPlan, robot: Robot, *, impact: bool = True) -> Touchdown:
    """Touchdown of a stage-1 plan; ``impact`` False keeps the velocities of the flight.

    Stage 1 has no posture, so for the impact the legs are bent until the CoM is where the plan has it, feet flat, trunk
    and arms as usual at touchdown; the whole body moves as one with the plan's velocity and angular momentum. Raises
    :class:`InfeasibleError` if the legs cannot put the CoM there.
    """
    flight = plan.flight
    com, velocity, momentum, rho = -flight.foot_com[-1], flight.com_velocity[-1], flight.L[-1], float(flight.rho[-1])
    if impact:
        q = configuration(robot, _posture(robot, com), toe=-robot.sagittal.sole_center)
        body = FullBody(robot)
        x = body.terms(q, after_impact(body.terms(q, _rigid_motion(robot, q, velocity, momentum))))
        velocity, momentum = x.com_velocity[[0, 2]], x.momentum[4]
    return Touchdown(com, velocity, float(momentum), rho)


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
