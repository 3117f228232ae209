"""A robot is data: a URDF, the roles of its joints, its soles and its standing posture."""

from jumplab.robot.description import Robot
from jumplab.robot.sagittal import SAGITTAL_JOINTS, SAGITTAL_LINKS, SagittalModel

__all__ = ["SAGITTAL_JOINTS", "SAGITTAL_LINKS", "Robot", "SagittalModel", "load_robot"]


def load_robot(name_or_config: str = "bhr") -> Robot:
    """Load a shipped robot by name (``"bhr"``) or any robot by the path of its TOML configuration.

    Raises
    ------
    RobotError
        If there is no such robot, or its files do not describe one.
    """
    return Robot.load(name_or_config)
