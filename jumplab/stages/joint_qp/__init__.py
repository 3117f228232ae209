"""Stage 2: mapping momentum and inertia to the joints with one QP per time step (Sec. IV of the paper).

``map_to_joints(srmp_plan, robot)`` does it all. To look inside, :class:`JointMapper` hands out the quantities, targets
and matrices of any step.
"""

from jumplab.stages.joint_qp.flight import FlightQp, FlightTarget
from jumplab.stages.joint_qp.launch import LaunchQp, LaunchTarget
from jumplab.stages.joint_qp.problem import State, StepQp
from jumplab.stages.joint_qp.rollout import JointMapper, JointPlan, Statistics, map_to_joints
from jumplab.stages.joint_qp.settings import (
    GENTLE,
    PRINTED,
    FlightWeights,
    Form,
    Gain,
    Gains,
    LaunchWeights,
    Limits,
    Options,
)
from jumplab.stages.joint_qp.solve import CvxpySolver, DirectSolver

__all__ = [
    "GENTLE",
    "PRINTED",
    "CvxpySolver",
    "DirectSolver",
    "FlightQp",
    "FlightTarget",
    "FlightWeights",
    "Form",
    "Gain",
    "Gains",
    "JointMapper",
    "JointPlan",
    "LaunchQp",
    "LaunchTarget",
    "LaunchWeights",
    "Limits",
    "Options",
    "State",
    "Statistics",
    "StepQp",
    "map_to_joints",
]
