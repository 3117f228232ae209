"""How far the hips bend before thigh and trunk meet: ranges must be those of the robot that is simulated."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

STEP_RAD = 0.02  # our choice: of the sweep; the range is cut one step early
FREE_M = 0.008  # our choice: distance kept between thigh and trunk


def free_range(urdf: str, hips: tuple[str, str]) -> tuple[float, float] | None:
    """(lower, upper) of the left hip's own angle [rad] within which neither thigh touches the trunk; None if all is.

    Both hips are turned together, by mirrored angles, every other joint at 0. The range is that around 0.
    """
    model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    shapes = pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION)
    thighs = [set(_thigh(model, model.getJointId(name))) for name in hips]
    trunk = [i for i, s in enumerate(shapes.geometryObjects) if s.parentJoint == 1]
    legs = [i for i, s in enumerate(shapes.geometryObjects) if any(s.parentJoint in t for t in thighs)]
    for i in trunk:
        for k in legs:
            shapes.addCollisionPair(pin.CollisionPair(i, k))
    if not len(shapes.collisionPairs):
        return None
    data, places = model.createData(), shapes.createData()
    left = model.getJointId(hips[0])
    low, high = (float(x[model.idx_qs[left]]) for x in (model.lowerPositionLimit, model.upperPositionLimit))
    signs = _signs(model, data, hips)

    def free(angle: float) -> bool:
        q = pin.neutral(model)
        for name, sign in zip(hips, signs, strict=True):
            q[model.idx_qs[model.getJointId(name)]] = sign * signs[0] * angle
        pin.computeDistances(model, data, shapes, places, q)
        return min(d.min_distance for d in places.distanceResults) > FREE_M

    ends = []
    for end in (low, high):
        grid = np.linspace(0.0, end, max(int(abs(end) / STEP_RAD), 1) + 1)
        met = next((i for i, angle in enumerate(grid) if not free(angle)), None)
        ends.append(end if met is None else float(grid[max(met - 1, 0)]))
    return None if ends == [low, high] else (ends[0], ends[1])


def _thigh(model: pin.Model, hip: int) -> list[int]:
    """The hip's body and those below it up to the first that carries a shape of its own leg: the thigh."""
    out = [hip]
    for joint in range(hip + 1, model.njoints):
        if model.parents[joint] in out and len(out) < 3 and not _is_pitch(model, joint):
            out.append(joint)
    return out


def _is_pitch(model: pin.Model, joint: int) -> bool:
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return abs(pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED)[4, model.idx_vs[joint]]) > 0.9


def _signs(model: pin.Model, data: pin.Data, names) -> list[float]:
    pin.computeJointJacobians(model, data, pin.neutral(model))
    joints = [model.getJointId(n) for n in names]
    return [float(np.sign(pin.getJointJacobian(model, data, j, pin.LOCAL_WORLD_ALIGNED)[4, model.idx_vs[j]]))
            for j in joints]  # fmt: skip
