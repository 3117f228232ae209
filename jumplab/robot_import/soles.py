"""The sole of a foot, from whatever shapes its links have: boxes, spheres, or meshes where they are on this machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumplab.robot_import.tree import Tree

SOLE_M = 0.012  # our choice: points this near the lowest one belong to the sole
SMALLEST_M = 0.03  # our choice: a shape shorter than this is a marker, no sole
# a sole where nothing is known, as shares of the leg's length from hip to ankle; our choice: the default robot's
GUESS = {"x": (-0.143, 0.2), "y": (-0.071, 0.071), "z": -0.107}


@dataclass(frozen=True)
class Sole:
    """Rectangle along the robot's axes, from the origin of the foot link [m]; ``source`` says where it comes from."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    source: str


def find_sole(tree: Tree, foot: str, turn: np.ndarray, leg_m: float, angles: dict | None = None) -> Sole:
    """Sole of the left foot.

    Parameters
    ----------
    foot : link of the foot.  turn : (3, 3) from the root's axes to the robot's.
    leg_m : length from hip to ankle, from which a sole is guessed if the foot has no shape.
    angles : joints that are held [rad].
    """
    pose = tree.poses(angles)
    found, kinds = [np.zeros((0, 3))], set()
    for link in _rigid(tree, foot):
        points = tree.points(link)
        if len(points):
            found.append((points @ pose[link].rotation.T + pose[link].translation - pose[foot].translation) @ turn.T)
            kinds |= {shape.kind for shape in tree.links[link].shapes}
    points = np.concatenate(found)
    if len(points):
        low = points[points[:, 2] < points[:, 2].min() + SOLE_M]
        (x0, y0, z), (x1, y1, _) = low.min(axis=0), low.max(axis=0)
        if x1 - x0 > SMALLEST_M and y1 - y0 > SMALLEST_M:
            return Sole(
                (float(x0), float(x1)), (float(y0), float(y1)), float(z), f"from its {' and '.join(sorted(kinds))}"
            )
    x, y = (tuple(float(leg_m * s) for s in GUESS[k]) for k in "xy")
    return Sole(x, y, float(leg_m * GUESS["z"]), "GUESSED from the leg's length: the foot has no shape that is at hand")


def _rigid(tree: Tree, link: str) -> list[str]:
    out = [link]
    for name in out:
        out += [j.child for j in tree.below[name] if j.kind == "fixed"]
    return out
