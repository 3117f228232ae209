"""Stage 2: mapping momentum and inertia to the joints with one QP per time step (Sec. IV of the
paper).

``map_to_joints(srmp, robot)`` does it all. To look inside, :class:`JointMapper` hands out the
quantities, targets and programs of any step.
"""

from jumplab.stages.joint_qp.point import Affine, StepPoint
from jumplab.stages.joint_qp.rollout import JointMapper, JointPlan, map_to_joints
from jumplab.stages.joint_qp.settings import Limits, Options
from jumplab.stages.joint_qp.terms import build_problem, changed_problem

__all__ = [
    "Affine",
    "JointMapper",
    "JointPlan",
    "Limits",
    "Options",
    "StepPoint",
    "build_problem",
    "changed_problem",
    "map_to_joints",
]
