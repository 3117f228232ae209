"""A robot is data: a URDF, the roles of its joints, its soles and its standing posture.

In: a shipped name, a TOML or a URDF. Out: an immutable :class:`Robot` and its :class:`SagittalModel` of five links.
Begin with :mod:`description`; stage 1's view of what the robot can do is in :mod:`reach`.
"""

from jumplab.robot.description import Robot
from jumplab.robot.sagittal import SAGITTAL_JOINTS, SAGITTAL_LINKS, SagittalModel

__all__ = ["SAGITTAL_JOINTS", "SAGITTAL_LINKS", "Robot", "SagittalModel"]
