"""The robot's files against each other, where a disagreement would make every engine simulate another robot."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np

from jumplab.auditing import limits as lim
from jumplab.auditing.replay import Replay
from jumplab.auditing.report import Check

GROUP = "robot"


def checks(r: Replay) -> list[Check]:
    """All checks of this group."""
    return [_sole(r), _massless(r)]


def _sole(r: Replay) -> Check:
    f = r.robot.foot
    said = np.array([f.heel, f.toe, -f.half_width, f.half_width, f.sole_z])
    off = [1e3 * np.abs(np.array([s.heel, s.toe, s.right, s.left, s.z]) - said).max() for s in r.soles]
    return Check(GROUP, "sole as in the URDF", float(max(off)), lim.SOLE_MM, "mm", None,
                 "sole rectangle of the robot's configuration against the foot's collision box")  # fmt: skip


def _massless(r: Replay) -> Check:
    bare = []
    for link in ET.fromstring(r.robot.urdf).iter("link"):
        mass = link.find("inertial/mass")
        if mass is None or not float(mass.get("value", "0")) > 0:
            bare.append(link.get("name", "unnamed"))
    note = "links without a mass, which Pinocchio reads as 0 kg, PyBullet as 1 kg and MuJoCo refuses"
    return Check(GROUP, "links have mass", len(bare), 0, "links", None, f"{note}: {', '.join(bare) or 'none'}")
