"""Standing posture: soles flat on the ground, CoM above their middle, at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.errors import RobotError
from jumplab.robot.sagittal import SAGITTAL_JOINTS, rotated

if TYPE_CHECKING:  # a robot is checked by this before anybody gets it
    from jumplab.robot.description import Robot

STANCE_ROOM_RAD = 0.04  # plans keep 0.03 off every stop
SHANK_LEAN_RAD = (-0.6, 1.4)  # generous, both ways
WIDTH_WEIGHT = 1e-3  # of the feet's distance in the neutral posture, which a robot keeps if it can
STANDS_M = 1e-3  # [m, rad] that a standing posture may miss: a leg of five joints whose sides differ


def com_from_toe(robot: Robot, angles: np.ndarray) -> np.ndarray:
    """CoM (x, z) from the toe [m] at absolute link angles (5,)."""
    model = robot.sagittal
    arms = np.einsum("i,ijk->jk", model.mass, model.com_arms()) / model.total_mass
    return np.sum([rotated(a, d) for a, d in zip(angles, arms, strict=True)], axis=0)


def stance_angles(robot: Robot, knee_rad: float | None = None, *, within_limits: bool = True) -> np.ndarray:
    """Absolute link angles (5,) of the standing posture, order foot, shank, thigh, trunk, arm [rad].

    Knee, trunk pitch and shoulder come from the robot's configuration (``knee_rad`` overrides the first); the shank's
    lean follows from the CoM above the middle of the sole. Raises :class:`RobotError` if no lean does that, or, unless
    ``within_limits`` is off, if a joint would leave its range.
    """
    knee = robot.stance["knee_rad"] if knee_rad is None else knee_rad
    pitch, shoulder = robot.stance["trunk_pitch_rad"], robot.stance["shoulder_rad"]

    def angles(shank):
        return np.array([0.0, shank, shank - knee, pitch, pitch + shoulder])

    found, m = angles(_level(robot, knee, pitch, pitch + shoulder)), robot.sagittal
    for name, angle, low, high in zip(SAGITTAL_JOINTS, m.joint_angles(found), m.lower, m.upper, strict=True):
        if within_limits and not low <= angle <= high:
            raise RobotError(
                f"robot {robot.name}: standing with the knee at {knee:g} rad needs {name} at {angle:.3f} rad, outside "
                f"its range {low:g} ... {high:g}; change [stance] in its configuration"
            )
    return found


def _level(robot: Robot, knee: float, trunk: float, arm: float) -> float:
    """Lean of the shank [rad] with the CoM above the middle of the sole.

    Shank and thigh turn together, so the CoM's x is a wave in the lean: x = mean + size cos(lean - peak).
    """

    def ahead(lean):
        return com_from_toe(robot, np.array([0.0, lean, lean - knee, trunk, arm]))[0] - robot.sagittal.sole_center[0]

    at_zero, quarter, half = ahead(0.0), ahead(np.pi / 2), ahead(np.pi)
    mean = (at_zero + half) / 2
    size, peak = np.hypot(at_zero - mean, quarter - mean), np.arctan2(quarter - mean, at_zero - mean)
    low, high = SHANK_LEAN_RAD
    turn = np.arccos(-mean / size) if abs(mean) < size else np.nan
    leans = [(lean - low) % (2 * np.pi) + low for lean in (peak - turn, peak + turn)]
    found = [float(lean) for lean in leans if lean <= high]
    if len(found) == 1:
        return found[0]
    raise RobotError(
        f"robot {robot.name}: with the knee at {knee:g} rad and the trunk at {trunk:g} rad no lean of the shank "
        f"brings the CoM above the middle of the sole; change [stance] in its configuration"
    )


def check_stance(robot: Robot) -> np.ndarray:
    """The standing posture (5,), refused if a joint has less than :data:`STANCE_ROOM_RAD` left to its stops."""
    if not robot.planar:
        return robot.standing
    angles, m = stance_angles(robot), robot.sagittal
    for name, angle, low, high in zip(SAGITTAL_JOINTS, m.joint_angles(angles), m.lower, m.upper, strict=True):
        if min(angle - low, high - angle) < STANCE_ROOM_RAD:
            raise RobotError(
                f"robot {robot.name}: standing, {name} is at {angle:.3f} rad, less than {STANCE_ROOM_RAD:g} from the "
                f"end of its range {low:.3g} ... {high:.3g}; no plan can start there: change [stance] in its "
                f"configuration"
            )
    return angles


def configuration(robot: Robot, angles: np.ndarray, toe: tuple[float, float] | np.ndarray = (0.0, 0.0)) -> np.ndarray:
    """Pinocchio configuration of the full robot for absolute link angles and the toe's (x, z) [m].

    One posture, (5,) and (2,) -> (nq,), or many, (n, 5) and (n, 2) -> (n, nq).
    """
    model, full, angles = robot.sagittal, robot.model, np.asarray(angles)
    base = np.asarray(toe) + sum(rotated(angles[..., j], model.span[j]) for j in range(3))
    base = base + rotated(angles[..., 3], model.base)
    q = np.broadcast_to(pin.neutral(full), (*angles.shape[:-1], full.nq)).copy()
    q[..., 0], q[..., 2] = base[..., 0], base[..., 1]
    q[..., 3:7] = 0.0
    q[..., 4], q[..., 6] = np.sin(angles[..., 3] / 2), np.cos(angles[..., 3] / 2)
    joints = model.joint_angles(angles)
    for name, row, sign in robot.role_signs():
        q[..., full.idx_qs[full.getJointId(name)]] = sign * joints[..., row]
    return q


def stance_configuration(robot: Robot) -> np.ndarray:
    """Pinocchio configuration (nq,) of the standing robot, middle of the soles at the origin."""
    if not robot.planar:
        return robot.standing.copy()
    return configuration(robot, stance_angles(robot), toe=-robot.sagittal.sole_center)


def leg_length(robot: Robot) -> float:
    """Height of the hip's pitch axis above the sole as the robot stands [m]."""
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, stance_configuration(robot))
    hip = data.oMi[model.getJointId(robot.joints["hip_pitch"][0])].translation
    sole = data.oMf[model.getFrameId(robot.foot.frames[0])].act(robot.foot.center)
    return float(hip[2] - sole[2])


# robots that need space ---------------------------------------------------------------------------------------------
def knees(robot: Robot) -> list[tuple[int, float, float]]:
    """(index into q[7:], sign, angle) of both knees: flexion = sign * q + angle, zero where the leg is straight.

    A planar robot's angles are what they are.
    """
    if robot.planar:
        return [(robot.joint_names.index(n), s, 0.0) for n, row, s in robot.role_signs() if row == 1]
    model, data = robot.model, robot.model.createData()
    jacobian, out = pin.computeJointJacobians(model, data, pin.neutral(model)), []
    for side in (0, 1):
        hip, knee, ankle = (model.getJointId(robot.joints[role][side]) for role in ("hip_pitch", "knee", "ankle_pitch"))
        axis = jacobian[3:, model.idx_vs[knee]]
        sign = 1.0 if axis[1] > 0 else -1.0
        across = np.eye(3) - np.outer(axis, axis)
        thigh, shank = (
            across @ (data.oMi[b].translation - data.oMi[a].translation) for a, b in ((hip, knee), (knee, ankle))
        )
        bent = np.arctan2(sign * axis @ np.cross(thigh, shank), thigh @ shank)
        out.append((model.idx_vs[knee] - 6, sign, float(bent)))
    return out


def rest_angles(robot: Robot) -> np.ndarray:
    """Angles (nv - 6,) of the joints as told for the standing posture, else zero or well inside the range [rad]."""
    rows = [robot.actuators[name] for name in robot.joint_names]
    low, high = (np.array([r[key] for r in rows]) for key in ("lower", "upper"))
    room = np.minimum(2 * STANCE_ROOM_RAD, (high - low) / 3)
    return np.clip([robot.rest.get(name, 0.0) for name in robot.joint_names], low + room, high - room)


def standing(robot: Robot) -> np.ndarray:
    """Pinocchio configuration (nq,) with flat feet that point ahead, the CoM above them, knees and trunk as told.

    Raises :class:`RobotError` if the legs reach no such posture within their ranges.
    """
    model, data, q = robot.model, robot.model.createData(), pin.neutral(robot.model)
    frames, bends, wish = [model.getFrameId(n) for n in robot.foot.frames], knees(robot), robot.stance["knee_rad"]
    supports = {j for f in frames for j in model.supports[model.frames[f].parentJoint]}
    legs = np.array([model.idx_qs[j] for j in sorted(supports) if j > 1])
    q[7:] = rest_angles(robot)
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, robot.stance["trunk_pitch_rad"], 0.0)).coeffs()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    first = [data.oMf[f].act(robot.foot.center) for f in frames]
    wide = abs(first[0][1] - first[1][1])
    for k, sign, angle in bends:
        q[7 + k] = sign * (wish - angle)

    def missing(x):
        q[[0, 2]], q[legs] = x[:2], x[2:]
        pin.centerOfMass(model, data, q)
        pin.framesForwardKinematics(model, data, q)
        rows = [data.com[0][0], np.mean([sign * q[7 + k] + angle for k, sign, angle in bends]) - wish]
        (x1, y1, z1), (x2, y2, z2) = (data.oMf[f].act(robot.foot.center) for f in frames)
        rows += [x1, x2, z1, z2, y1 + y2]
        for axes in (data.oMf[f].rotation for f in frames):
            rows += [axes[2, 0], axes[2, 1], axes[1, 0]]
        return np.array([*rows, WIDTH_WEIGHT * (y1 - y2 - wide)])

    from scipy.optimize import least_squares  # slow to import, and for robots that no plane describes

    low, high = (x[legs] for x in (model.lowerPositionLimit, model.upperPositionLimit))
    room = np.minimum(STANCE_ROOM_RAD, (high - low) / 3)
    begin = np.concatenate([[0.0, -np.mean(first, axis=0)[2]], np.clip(q[legs], low + room, high - room)])
    ends = np.concatenate([[-np.inf] * 2, low + room]), np.concatenate([[np.inf] * 2, high - room])
    begin = np.clip(begin, ends[0] + 1e-9, ends[1] - 1e-9)
    found = least_squares(missing, begin, bounds=ends, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    if np.abs(missing(found.x)[:-1]).max() > STANDS_M:
        raise RobotError(
            f"robot {robot.name}: no standing posture with the knees at {wish:g} rad and the trunk at "
            f"{robot.stance['trunk_pitch_rad']:g} rad has flat feet below the CoM, "
            f"{1e3 * np.abs(found.fun[:-1]).max():.0f} mm or mrad are missing; change [stance] in its configuration"
        )
    return q


def holding(robot: Robot, q: np.ndarray, friction: float) -> tuple[float, str, float] | None:
    """What joints need at least to hold a posture ``q`` (nq,) whose soles are on the ground, under the robot's gravity.

    The ground's forces on the corners of both soles, within friction, are shared out so that the joint that uses most
    of its effort uses as little as can be. Returns that share [1], the joint, and its torque [N m]; None if no forces
    of the ground balance the posture.
    """
    from scipy.optimize import linprog  # slow to import

    model, frames = robot.model, [robot.model.getFrameId(name) for name in robot.foot.frames]
    data = model.createData()
    weight = pin.computeGeneralizedGravity(model, data, q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    level = friction / np.sqrt(2)
    edges = np.array([[x, y, 1.0] for x in (-level, level) for y in (-level, level)])
    pushes = []
    for frame in frames:
        slope = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        for corner in robot.foot.corners:
            point = slope[:3] - pin.skew(data.oMf[frame].rotation @ corner) @ slope[3:]
            pushes.extend(edges @ point)
    pushed, effort = np.array(pushes).T, np.array([robot.actuators[name]["effort"] for name in robot.joint_names])
    cost = np.append(np.zeros(pushed.shape[1]), 1.0)
    rows = np.block([[-pushed[6:], -effort[:, None]], [pushed[6:], -effort[:, None]]])
    base = np.hstack([pushed[:6], np.zeros((6, 1))])
    found = linprog(cost, rows, np.concatenate([-weight[6:], weight[6:]]), base, weight[:6])
    if not found.success:
        return None
    torque = weight[6:] - pushed[6:] @ found.x[:-1]
    most = int(np.argmax(np.abs(torque) / effort))
    return float(found.x[-1]), robot.joint_names[most], float(abs(torque[most]))
