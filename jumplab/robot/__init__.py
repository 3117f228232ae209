"""A robot is data: a URDF, the roles of its joints, its soles and its standing posture.

In: a shipped name, a TOML or a URDF. Out: an immutable :class:`Robot` and its :class:`SagittalModel` of five links.
Begin with :mod:`description`; stage 1's view of what the robot can do is in :mod:`reach`.
"""

from jumplab.robot.description import SHIPPED, Robot
from jumplab.robot.reach import postures
from jumplab.robot.sagittal import JOINT_OF_ANGLES, SAGITTAL_JOINTS, SAGITTAL_LINKS, SagittalModel
from jumplab.robot.stance import configuration

__all__ = [
    "JOINT_OF_ANGLES",
    "SAGITTAL_JOINTS",
    "SAGITTAL_LINKS",
    "SHIPPED",
    "Robot",
    "SagittalModel",
    "configuration",
    "postures",
]
