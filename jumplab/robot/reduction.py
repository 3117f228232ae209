"""Whether the five links of the sagittal plane stand for a robot, and which of its joints mirror
each other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.contact import on_feet, posed

if TYPE_CHECKING:  # a robot is asked by this what it is
    from jumplab.robot.description import Robot

# cosine: with axes canted by 2.6 deg the five links miss the CoM by a millimetre, as the audit
# allows
PARALLEL = 0.999
MIRROR = np.array([1.0, -1.0, 1.0])  # times a vector: its mirror image
SAME_M = 0.02  # between a joint and the mirror image of its counterpart: built alike; evened out
EXACT_M = 1e-6
EXACT_SHARE = 1e-5  # of a body's mass, and of its centre [m], to its counterpart's


def mirror(model: pin.Model, most_m: float = SAME_M) -> list[tuple[int, int, float]]:
    """Joints that mirror each other in the x-z plane of the neutral pose: (index, index, sign),
    indices into v[6:].

    A joint in the middle is its own counterpart; one without any is left out. Mirrored motions have
    ``v[6 + other] = sign * v[6 + one]``. Places may differ by ``most_m`` [m], axes by as many
    radians.
    """
    data = posed(model)
    axis = data.J[3:, 6:].T
    place = np.array([data.oMi[j].translation for j in range(2, model.njoints)])
    pairs = []
    for i in range(len(axis)):
        signs = np.where(-axis @ (MIRROR * axis[i]) > 0, 1.0, -1.0)
        gaps = np.hstack([MIRROR * place[i] - place, signs[:, None] * MIRROR * axis[i] + axis])
        gaps = np.abs(gaps).max(axis=1)
        k = int(np.argmin(gaps))
        if gaps[k] < most_m and k >= i:
            pairs.append((i, k, float(signs[k])))
    return pairs


def in_plane(robot: Robot) -> bool:
    """Whether five links describe a robot: its moving joints are those of legs and swinging arms,
    those with a role turn about the pitch axis, soles are level with joints at 0, and left and
    right are alike."""
    model = robot.model
    pairs = mirror(model, EXACT_M)
    feet = on_feet(robot, np.zeros(3))
    in_legs = {j for foot in feet for j in model.supports[foot.joint]}
    roles = {name for pair in robot.joints.values() for name in pair}
    free = {model.names[j] for j in range(2, model.njoints) if j not in in_legs} - roles
    data = posed(model)
    level = max(abs(foot.place(data).rotation[2, 0]) for foot in feet) < EXACT_M
    pitch = [data.J[4, model.idx_vs[model.getJointId(name)]] for name in roles]
    try:
        _ = robot.sagittal
    except RobotError:  # left and right share no angle
        return False
    mirrored = len({i for row in pairs for i in row[:2]}) == model.nv - 6
    alike = mirrored and even_masses(model, pairs)
    return alike and level and not free and min(np.abs(pitch)) > PARALLEL


def even_masses(model: pin.Model, pairs: list[tuple[int, int, float]]) -> bool:
    """Whether the base and mirrored bodies, rows (i, k, sign), have mirrored masses and centres."""
    for i, k in [(-1, -1), *(pair[:2] for pair in pairs)]:  # -1 is the base
        left, right = (model.inertias[2 + joint] for joint in (i, k))
        apart = np.abs(MIRROR * left.lever - right.lever).max() * left.mass
        if max(abs(left.mass - right.mass), apart) > EXACT_SHARE * left.mass:
            return False
    return True
