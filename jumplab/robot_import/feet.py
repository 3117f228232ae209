"""Contact surfaces of feet: soles from the shapes of their links; and legs that end in wheels."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.robot_import.checks import MOST_RAD
from jumplab.robot_import.urdf import Joint, Tree, across, numbers, placed
from jumplab.robot_import.write import listed

# None of these numbers is printed by the paper.
LEANS_RAD = 1.3  # within which a foot is looked for level, in such steps; a shank lies beyond
STEP_RAD = np.pi / 180
STANDS = 0.1  # sine: a cylinder that leans by less than 6 deg stands on its end
# shares of the leg's length: shapes smaller than this are markers or points, no soles; and what is
# so little above the lowest point belongs to the sole, at most SOLE_M; no sole is LONGEST legs long
SMALLEST = 0.04
LONGEST = 2.0
SOLE_SHARE = 0.02
SOLE_M = 0.012
# a sole where nothing is known: the default robot's, as shares of the leg's length from hip to
# ankle
GUESS_X = (-0.143, 0.2)
GUESS_Y = (-0.071, 0.071)
GUESS_Z = -0.107
# of a wheel: how far down it reaches at least, of how far it does at most, turned by these steps;
# 0.71 of a square, 0.87 of the coarsest mesh of a wheel, a hexagon
ROUND_SHARE = 0.8
TURN_RAD = np.pi / 6


@dataclass(frozen=True)
class Sole:
    """Rectangle along the robot's axes, from the foot link's origin [m], and its source.

    ``level`` is the pitch of the ankle at which it lies level, all other joints at 0 [rad].
    """

    x: tuple[float, float]
    y: tuple[float, float]
    z: float
    source: str
    level: float = 0.0


def find_sole(tree: Tree, foot: str, turn: np.ndarray, leg_m: float) -> Sole:
    """Sole of the left foot, from whatever shapes its links have: boxes, spheres, or meshes that
    are at hand.

    ``turn`` (3, 3) leads from the root's axes to the robot's; from ``leg_m``, the length from hip
    to ankle, a sole is guessed if the link ``foot`` has no shape.
    """
    thick = thickness(leg_m)
    touching, around, kinds = sole_points(tree, foot, turn, thick)
    if not kinds:
        x, y = (tuple(leg_m * share for share in shares) for shares in (GUESS_X, GUESS_Y))
        files = [shape.get("filename") for x in tree.below(foot) for _, shape in tree.shapes(x)]
        lost = listed(sorted({*filter(None, files)}))
        source = "GUESSED from the leg's length: no shape of the foot could be read"
        source += f", the mesh {lost} is not there" if lost else ""
        return Sole(x, y, leg_m * GUESS_Z, source)
    source = f"from its {' and '.join(sorted(kinds))}"
    least = SMALLEST * leg_m
    level = 0.0
    if np.ptp(touching[:, 0]) < least:
        level = _level(tree, foot, turn, leg_m)
        turn = pin.rpy.rpyToMatrix(0.0, level, 0.0) @ turn
        touching, around, _ = sole_points(tree, foot, turn, thick)
    long = np.ptp(touching[:, :2], axis=0)
    if max(long) < least:
        wide = 1e3 * max(np.ptp(around[:, :2], axis=0))
        raise tree.error(
            f"the foot {foot!r} touches the ground in a point ({source}, {wide:.0f} mm wide): it "
            f"has no sole, and jumps are planned for feet that stand flat; give the foot a shape "
            f"with a level lower side"
        )
    if max(long) > LONGEST * leg_m:
        raise tree.error(
            f"the sole of the foot {foot!r} measures {max(long):.3g} m ({source}), the leg "
            f"{leg_m:.3g} m; are its shapes in millimetres? give a mesh scale = "
            f'"0.001 0.001 0.001", or divide their sizes by 1000'
        )
    ends = []
    for axis in range(2):
        even = long[axis] >= least
        along = (touching if even else around)[:, axis]
        ends.append((float(along.min()), float(along.max())))
        source += "" if even else ", whose round side counts as level"
    return Sole(*ends, float(touching[:, 2].min()), source, level)


def _level(tree: Tree, foot: str, turn: np.ndarray, leg_m: float) -> float:
    """Pitch [rad] at which a foot stands on most of its length; 0 if none helps much."""
    _, points, _ = sole_points(tree, foot, turn, np.inf)

    def pitched(angle: float) -> np.ndarray:
        return points @ pin.rpy.rpyToMatrix(0.0, angle, 0.0).T

    def length(angle: float) -> float:  # that touches [m]
        x, _, z = pitched(angle).T
        return np.ptp(x[z < z.min() + thickness(leg_m)])

    # the first of the best, from the middle outwards
    best = max(sorted(np.arange(-LEANS_RAD, LEANS_RAD, STEP_RAD), key=abs), key=length)
    if length(best) <= 3 * SMALLEST * leg_m:
        return 0.0
    turned = pitched(best)
    ahead = turned[:, 0] > turned[:, 0].min() + np.ptp(turned[:, 0]) / 2
    heel, toe = (half[np.argmin(half[:, 2])] for half in (turned[~ahead], turned[ahead]))
    return float(best + np.arctan2(toe[2] - heel[2], toe[0] - heel[0]))


def thickness(leg_m: float) -> float:
    """Height over the lowest point of a foot up to which its points belong to the sole [m]."""
    return min(SOLE_M, SOLE_SHARE * leg_m)


def sole_points(
    tree: Tree, foot: str, turn: np.ndarray, thick_m: float
) -> tuple[np.ndarray, np.ndarray, set[str]]:
    """Points of a foot and its toes at most ``thick_m`` [m] above the lowest, (n, 3) from its
    origin along the axes ``turn`` (3, 3): those that touch level ground, and corners around
    its shapes, which are farther out where these are round; and the kinds of shapes.

    Pictures count where there are no collision shapes.
    """
    axes = pin.SE3(turn, -turn @ tree.pose[foot].translation)
    touching = [np.zeros((0, 3))]
    around = [np.zeros((0, 3))]
    kinds = set()
    for kind in ("collision", "visual"):
        for part in tree.below(foot) if not kinds else ():
            for place, shape in tree.shapes(part, kind):
                at = axes * tree.pose[part] * place
                if len(corners := tree.corners(shape)):
                    around.append(placed(at, corners))
                    touching.append(_lowest(shape, corners, at))
                    kinds.add(shape.tag)
    touching, around = map(np.concatenate, (touching, around))
    level = touching[:, 2].min(initial=np.inf) + thick_m
    return touching[touching[:, 2] < level], around[around[:, 2] < level], kinds


def _lowest(shape: ET.Element, corners: np.ndarray, place: pin.SE3) -> np.ndarray:
    """(n, 3) points of a placed shape that may touch level ground: one of a sphere, two of a
    capsule or of a cylinder that lies, else its ``corners`` (n, 3).
    """
    if not shape.get("radius"):
        return placed(place, corners)
    radius = numbers(shape.get("radius"), 1)[0]
    length = 0.0 if shape.tag == "sphere" else numbers(shape.get("length"), 1)[0]
    along = place.rotation[:, 2]
    down = np.array([0.0, 0.0, -1.0])
    if shape.tag == "cylinder":
        down = across(down, along)
        if np.linalg.norm(down) < STANDS:
            return placed(place, corners)
        down = down / np.linalg.norm(down)
    ends = np.array([-0.5, 0.5]) if length else np.zeros(1)
    return place.translation + np.outer(ends * length, along) + radius * down


def refuse_wheel(tree: Tree, ankle: Joint) -> None:
    """Raise if a leg ends in a wheel: a joint without stops whose body is round about it."""
    stops = [ankle.limits.get(end, np.inf) for end in ("lower", "upper")]
    if ankle.kind != "continuous" and np.abs(stops).max() <= MOST_RAD:
        return
    for part in tree.bodies[tree.carrier[ankle.child]]:
        to_joint = tree.pose[ankle.child].actInv(tree.pose[part])
        for place, shape in tree.shapes(part) + tree.shapes(part, "visual"):
            if _round(tree, shape, to_joint * place, ankle.axis):
                raise tree.error(
                    f"the legs end in wheels: joint {ankle.name!r} turns without stops, and its "
                    f"body {part!r} is round about it; jumps are planned for feet with soles"
                )


def _round(tree: Tree, shape: ET.Element, place: pin.SE3, axis: np.ndarray) -> bool:
    """Whether a shape, at its ``place`` in the frame of a joint, reaches as far below the joint's
    axis (3,) however it is turned about that.
    """
    level = pin.Quaternion.FromTwoVectors(axis, np.array([0.0, 1.0, 0.0])).toRotationMatrix()
    turns = [pin.rpy.rpyToMatrix(0.0, turn, 0.0) for turn in np.arange(0.0, 2 * np.pi, TURN_RAD)]
    corners = tree.corners(shape)
    ways = [_lowest(shape, corners, pin.SE3(turn @ level, np.zeros(3)) * place) for turn in turns]
    deep = [-way[:, 2].min(initial=0.0) for way in ways]
    return min(deep) > ROUND_SHARE * max(deep)
