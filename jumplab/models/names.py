"""Quantities of joints by name, as own terms see them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jumplab.errors import quoted
from jumplab.robot import SAGITTAL_JOINTS, Robot


class ByJoint:
    """One quantity of the joints by name: ``.left_knee`` is one's own, ``.knee`` left and right (2,), about +y.

    Parameters
    ----------
    robot : whose joints.  values : (joints,) numbers, or a column that is no number yet.
    """

    def __init__(self, robot: Robot, values: Any):
        self._robot, self._values = robot, values

    def __getattr__(self, name: str) -> Any:
        robot = self._robot
        own = {joint: ([k], [1.0]) for k, joint in enumerate(robot.joint_names)}
        for role in SAGITTAL_JOINTS:
            pair = [(joint, sign) for joint, row, sign in robot.role_signs() if SAGITTAL_JOINTS[row] == role]
            if pair:  # else the arms are held
                own[role] = [robot.joint_names.index(joint) for joint, _ in pair], [sign for _, sign in pair]
        if name not in own:
            raise AttributeError(f"there is no joint {quoted(name)}; there are {', '.join(own)}")
        rows, signs = own[name]
        return self._values[rows] * np.array(signs)
