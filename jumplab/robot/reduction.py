"""Whether the five links of the sagittal plane stand for a robot, and which of its joints mirror each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError

if TYPE_CHECKING:  # a robot is asked by this what it is
    from jumplab.robot.description import Robot

PARALLEL = 0.999  # cosine: with axes canted by 2.6 deg the five links miss the CoM by a millimetre, as the audit allows
SAME_M, EXACT_M = 0.02, 1e-6  # between a joint and the mirror image of its counterpart: built alike; evened out
EXACT_SHARE = 1e-5  # of a body's mass, and of its centre [m], to its counterpart's


def mirror(model: pin.Model, most_m: float = SAME_M) -> list[tuple[int, int, float]]:
    """Joints that mirror each other in the x-z plane of the neutral pose: (index, index, sign), indices into v[6:].

    A joint in the middle is its own counterpart; one without any is left out. Mirrored motions have
    ``v[6 + other] = sign * v[6 + one]``. Places may differ by ``most_m`` [m], axes by as many radians.
    """
    data, flip, found = model.createData(), np.array([1.0, -1.0, 1.0]), []
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    axis = [jacobian[3:, model.idx_vs[j]] for j in range(2, model.njoints)]
    place = [data.oMi[j].translation for j in range(2, model.njoints)]
    for i in range(len(axis)):
        gaps = []
        for k in range(len(axis)):
            sign = 1.0 if -flip * axis[i] @ axis[k] > 0 else -1.0
            off = np.abs(flip * place[i] - place[k]).max(), np.abs(-sign * flip * axis[i] - axis[k]).max()
            gaps.append((max(off), k, sign))
        gap, k, sign = min(gaps)
        if gap < most_m and k >= i:
            found.append((i, k, sign))
    return found


def in_plane(robot: Robot) -> bool:
    """Whether five links describe a robot: its moving joints are those of legs and swinging arms, those with a role
    turn about the pitch axis, and left and right are alike."""
    model, pairs = robot.model, mirror(robot.model, EXACT_M)
    feet = [model.frames[model.getFrameId(name)].parentJoint for name in robot.foot.frames]
    in_legs = {j for foot in feet for j in model.supports[foot]}
    free = {model.names[j] for j in range(2, model.njoints) if j not in in_legs} - set(robot.joints["shoulder_pitch"])
    axes = pin.computeJointJacobians(model, model.createData(), pin.neutral(model))[4]
    pitch = [axes[model.idx_vs[model.getJointId(name)]] for pair in robot.joints.values() for name in pair]
    try:
        ranges = robot.sagittal is not None
    except RobotError:  # left and right share no angle
        ranges = False
    mirrored = len({i for row in pairs for i in row[:2]}) == model.nv - 6
    return ranges and mirrored and even_masses(model, pairs) and not free and min(np.abs(pitch)) > PARALLEL


def even_masses(model: pin.Model, pairs: list[tuple[int, int, float]]) -> bool:
    """Whether the base and the bodies of mirrored joints (:func:`mirror`) have mirrored masses and centres."""
    bodies = [(model.inertias[2 + i], model.inertias[2 + k]) for i, k, _ in pairs]
    return all(_alike(a, b) for a, b in [(model.inertias[1], model.inertias[1]), *bodies])


def _alike(left: pin.Inertia, right: pin.Inertia) -> bool:
    """Whether two bodies, in parallel frames, have mirrored masses and centres."""
    off = np.abs(left.lever * [1.0, -1.0, 1.0] - right.lever).max() * left.mass
    return abs(left.mass - right.mass) <= EXACT_SHARE * left.mass and off <= EXACT_SHARE * left.mass
