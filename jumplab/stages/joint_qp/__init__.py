"""Stage 2: mapping momentum and inertia to the joints with one QP per time step (Sec. IV of the paper).

``map_to_joints(srmp_plan, robot)`` does it all. To look inside, :class:`JointMapper` hands out the quantities, targets
and matrices of any step.
"""

from jumplab.stages.joint_qp.rollout import JointMapper, JointPlan, map_to_joints
from jumplab.stages.joint_qp.settings import Limits, Options
from jumplab.stages.joint_qp.solve import CvxpySolver, DirectSolver

__all__ = ["CvxpySolver", "DirectSolver", "JointMapper", "JointPlan", "Limits", "Options", "map_to_joints"]
