"""Quantities of joints by name, as own terms see them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jumplab.errors import quoted
from jumplab.robot import SAGITTAL_JOINTS, Robot


class ByJoint:
    """One quantity of the joints by name: ``.left_knee`` is one's own, ``.knee`` left and right
    (2,), about +y.

    Parameters
    ----------
    robot : whose joints.  values : (joints,) numbers, or a column that is no number yet.
    """

    def __init__(self, robot: Robot, values: Any):
        self._robot = robot
        self._values = values

    def __getattr__(self, name: str) -> Any:
        robot = self._robot
        known = {joint: [(joint, 1.0)] for joint in robot.joint_names}
        for joint, row, sign in robot.role_signs():
            known.setdefault(SAGITTAL_JOINTS[row], []).append((joint, sign))
        if name not in known:
            raise AttributeError(f"there is no joint {quoted(name)}; there are {', '.join(known)}")
        rows = [robot.joint_names.index(joint) for joint, _ in known[name]]
        return self._values[rows] * np.array([sign for _, sign in known[name]])
