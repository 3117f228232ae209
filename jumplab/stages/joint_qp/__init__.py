"""Stage 2: mapping momentum and inertia to the joints with one QP per time step (Sec. IV of the paper).

``map_to_joints(srmp_plan, robot)`` does it all. To look inside, :class:`JointMapper` hands out the quantities, targets
and matrices of any step. Own terms, weights and blocks left out go to
both; :func:`terms_table` lists all blocks.
"""

from jumplab.stages.joint_qp.changes import changed, terms_table
from jumplab.stages.joint_qp.own import Affine, StepPoint
from jumplab.stages.joint_qp.rollout import JointMapper, JointPlan, map_to_joints
from jumplab.stages.joint_qp.settings import Limits, Options
from jumplab.stages.joint_qp.solve import CvxpySolver, DirectSolver

__all__ = [
    "Affine",
    "CvxpySolver",
    "DirectSolver",
    "JointMapper",
    "JointPlan",
    "Limits",
    "Options",
    "StepPoint",
    "changed",
    "map_to_joints",
    "terms_table",
]
