"""Standing posture: soles flat on the ground, at rest, CoM above their middle, or nearer to the
ankles where these are weak.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from jumplab.errors import InfeasibleError, RobotError
from jumplab.robot.contact import FRICTION, on_feet, posed
from jumplab.robot.files import LEG
from jumplab.robot.sagittal import SAGITTAL_JOINTS, TO_COMPLEX, in_xz
from jumplab.task import GRAVITY

if TYPE_CHECKING:  # a robot is checked by this before it is returned
    from jumplab.robot.description import Robot

STANCE_ROOM_RAD = 0.04  # plans keep 0.03 off every stop
SHANK_LEAN_RAD = (-0.6, 1.4)  # generous, both ways
# of the ankles' torque that holds the CoM ahead of them: launches and landings need the rest
ANKLE_SHARE = 0.4
WITHIN_SHARE = 0.7  # of half the sole, from its middle, within which the CoM stands anyway
WIDTH_WEIGHT = 1e-3  # of the feet's distance in the neutral posture, which a robot keeps if it can
# [m, rad] that a standing posture may miss: a leg of five joints whose sides differ
STANDS_M = 1e-3
CHANGE_STANCE = "change [stance] in its configuration"
# [rad] knees and trunks of postures that are tried where the stance of a robot cannot be reached
OTHER_STANCES = ((0.3, 0.0), (0.3, 0.2), (0.8, 0.05), (0.8, 0.25), (1.2, 0.1), (1.2, 0.3))


def standing_ahead_m(robot: Robot) -> float:
    """By how much the CoM stands ahead of the middle of the soles [m]: 0, but where ankles would
    need more than :data:`ANKLE_SHARE` of their torque; then as near to it as that allows.
    """
    model = robot.model
    data = posed(model)
    names = robot.joints["ankle_pitch"]
    ankles = [data.oMi[model.getJointId(name)].translation for name in names]
    sides = zip(on_feet(robot, robot.foot.center), ankles, strict=True)
    ankle_m = np.mean([foot.place(data).actInv(ankle)[0] for foot, ankle in sides])
    effort = sum(robot.actuators[name]["effort"] for name in names)
    way = ANKLE_SHARE * effort / (robot.total_mass * GRAVITY)
    inside = WITHIN_SHARE * (robot.foot.toe - robot.foot.heel) / 2
    return float(np.clip(np.clip(0.0, ankle_m - way, ankle_m + way), -inside, inside))


def com_from_toe(robot: Robot, angles: np.ndarray) -> np.ndarray:
    """CoM (x, z) from the toe [m] at absolute link angles (5,) [rad]."""
    return in_xz(np.exp(-1j * angles) @ robot.sagittal.mean_arms)


def stance_angles(robot: Robot, *, within_limits: bool = True) -> np.ndarray:
    """Absolute link angles (5,) of the standing posture, order foot, shank, thigh, trunk, arm
    [rad].

    Knee, trunk pitch and shoulder come from the robot's configuration; the shank's lean follows
    from the CoM above the middle of the sole (see :func:`standing_ahead_m`). Raises
    :class:`RobotError` if no lean does that, or, unless ``within_limits`` is off, if a joint would
    leave its range.
    """
    knee = robot.stance["knee_rad"]
    pitch = robot.stance["trunk_pitch_rad"]
    arm = pitch + robot.stance["shoulder_rad"]
    shank = _lean(robot, knee, pitch, arm)
    angles = np.array([0.0, shank, shank - knee, pitch, arm])
    for name, angle, low, high in _joints(robot, angles):
        if within_limits and not low <= angle <= high:
            raise robot.error(
                f"standing with the knee at {knee:g} rad needs {name} at {angle:.3f} rad, outside "
                f"its range {low:g} ... {high:g}; {CHANGE_STANCE}"
            )
    return angles


def _joints(robot: Robot, angles: np.ndarray) -> zip:
    """(name, angle, lower, upper) [rad] of the sagittal joints at absolute link angles (5,)."""
    m = robot.sagittal
    return zip(SAGITTAL_JOINTS, m.joint_angles(angles), m.lower, m.upper, strict=True)


def _lean(robot: Robot, knee: float, trunk: float, arm: float) -> float:
    """Lean of the shank [rad] with the CoM where it stands, see :func:`standing_ahead_m`.

    Shank and thigh turn together, so the CoM's x is a wave in the lean: x = mean + size cos(lean -
    peak).
    """
    arms = robot.sagittal.mean_arms
    wave = arms[1] + arms[2] * np.exp(1j * knee)
    still = arms[0] + arms[3] * np.exp(-1j * trunk) + arms[4] * np.exp(-1j * arm)
    mean = still.real - robot.sagittal.sole_center[0] - standing_ahead_m(robot)
    turn = np.arccos(-mean / abs(wave)) if abs(mean) < abs(wave) else np.nan
    low, high = SHANK_LEAN_RAD
    leans = [(np.angle(wave) + x - low) % (2 * np.pi) + low for x in (-turn, turn)]
    inside = [float(lean) for lean in leans if lean <= high]
    if len(inside) == 1:
        return inside[0]
    raise robot.error(
        f"with the knee at {knee:g} rad and the trunk at {trunk:g} rad no lean of the shank brings "
        f"the CoM above the middle of the sole; {CHANGE_STANCE}"
    )


def check_stance(robot: Robot) -> np.ndarray:
    """The standing posture (5,) or (nq,), refused with less than :data:`STANCE_ROOM_RAD` to a stop;
    the sentence ends with another [stance] that can, if one was found.
    """
    try:
        return _checked_stance(robot)
    except RobotError as e:
        raise RobotError(str(e).replace(CHANGE_STANCE, _other_stance(robot))) from None


def _other_stance(robot: Robot) -> str:
    """Advice, in a sentence: values of [stance] with which the robot can stand, or that none was
    found.
    """
    others = [{"shoulder_rad": 0.0}]
    others += [{"knee_rad": knee, "trunk_pitch_rad": trunk} for knee, trunk in OTHER_STANCES]
    for other in others:
        try:
            _checked_stance(robot.with_stance(**other))
        except RobotError:
            continue
        values = " and ".join(f"{key} = {angle:g}" for key, angle in other.items())
        return f"with {values} in [stance] the robot can stand"
    knees, trunks = zip(*OTHER_STANCES, strict=True)
    return (
        f"the robot cannot stand with knees at {min(knees):g} ... {max(knees):g} and the trunk at "
        f"{min(trunks):g} ... {max(trunks):g} rad in [stance] either; correct its ranges or its "
        f"soles"
    )


def _checked_stance(robot: Robot) -> np.ndarray:
    if not robot.planar:
        return robot.standing
    angles = stance_angles(robot)
    for name, angle, low, high in _joints(robot, angles):
        if min(angle - low, high - angle) < STANCE_ROOM_RAD:
            raise robot.error(
                f"standing, {name} is at {angle:.3f} rad, less than "
                f"{STANCE_ROOM_RAD:g} from the end of its range {low:.3g} ... {high:.3g}; no plan "
                f"can start there; {CHANGE_STANCE}"
            )
    return angles


def configuration(
    robot: Robot, angles: np.ndarray, toe: tuple[float, float] | np.ndarray = (0.0, 0.0)
) -> np.ndarray:
    """Pinocchio configuration of the full robot for absolute link angles and the toe's (x, z) [m].

    One posture, (5,) and (2,) -> (nq,), or many, (n, 5) and (n, 2) -> (n, nq).
    """
    model = robot.sagittal
    full = robot.model
    angles = np.asarray(angles)
    base = in_xz(np.exp(-1j * angles[..., :4]) @ ([*model.span[:3], model.base] @ TO_COMPLEX))
    q = np.broadcast_to(pin.neutral(full), (*angles.shape[:-1], full.nq)).copy()
    q[..., [0, 2]] = np.asarray(toe) + base
    q[..., 4] = np.sin(angles[..., 3] / 2)
    q[..., 6] = np.cos(angles[..., 3] / 2)
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
    data = posed(robot.model, stance_configuration(robot))
    hip = data.oMi[robot.model.getJointId(robot.joints["hip_pitch"][0])]
    foot, _ = on_feet(robot, robot.foot.center)
    return float(hip.translation[2] - foot.place(data).translation[2])


# robots that need space
# ---------------------------------------------------------------------------------------------
def knees(robot: Robot) -> list[tuple[int, float, float]]:
    """(index into q[7:], sign, angle) of both knees: flexion = sign * q + angle, zero where the leg
    is straight.

    A planar robot's angles are what they are.
    """
    if robot.planar:
        return [
            (robot.joint_names.index(n), s, 0.0) for n, row, s in robot.role_signs() if row == 1
        ]
    model = robot.model
    data = posed(model)
    out = []
    for legs in zip(*(robot.joints[role] for role in LEG), strict=True):
        hip, knee, ankle = (data.oMi[model.getJointId(name)].translation for name in legs)
        column = model.idx_vs[model.getJointId(legs[1])]
        sign = 1.0 if data.J[4, column] > 0 else -1.0
        axis = sign * data.J[3:, column]
        thigh = knee - hip
        shank = ankle - knee
        straight = thigh @ shank - (axis @ thigh) * (axis @ shank)
        bent = np.arctan2(axis @ np.cross(thigh, shank), straight)
        out.append((column - 6, sign, float(bent)))
    return out


def rest_angles(robot: Robot) -> np.ndarray:
    """Angles (nv - 6,) [rad] of the standing posture: those of [rest], else 0; well inside the
    range.
    """
    low = robot.limits.lower
    high = robot.limits.upper
    room = np.minimum(2 * STANCE_ROOM_RAD, (high - low) / 3)
    angles = [robot.rest.get(name, 0.0) for name in robot.joint_names]
    return np.clip(angles, low + room, high - room)


def standing(robot: Robot) -> np.ndarray:
    """Pinocchio configuration (nq,) with flat feet that point ahead, the CoM above them, knees and
    trunk as in [stance].

    Raises :class:`RobotError` if the legs reach no such posture within their ranges.
    """
    # slow to import, and for robots that no plane describes
    from scipy.optimize import least_squares

    model = robot.model
    data = model.createData()
    feet = on_feet(robot, robot.foot.center)
    bends = knees(robot)
    knee = robot.stance["knee_rad"]
    trunk = robot.stance["trunk_pitch_rad"]
    above = standing_ahead_m(robot)
    legs = np.unique([model.idx_qs[j] for a in feet for j in model.supports[a.joint] if j > 1])

    def soles(q: np.ndarray) -> list[pin.SE3]:
        pin.forwardKinematics(model, data, q)
        return [foot.place(data) for foot in feet]

    q = pin.neutral(model)
    first = np.array([sole.translation for sole in soles(q)])
    wide = abs(first[0, 1] - first[1, 1])
    q[7:] = rest_angles(robot)
    q[4] = np.sin(trunk / 2)
    q[6] = np.cos(trunk / 2)
    for k, sign, angle in bends:
        q[7 + k] = sign * (knee - angle)

    def missing(x: np.ndarray) -> np.ndarray:
        q[[0, 2]] = x[:2]
        q[legs] = x[2:]
        left, right = soles(q)
        (x1, y1, z1), (x2, y2, z2) = left.translation, right.translation
        tilts = [sole.rotation[[2, 2, 1], [0, 1, 0]] for sole in (left, right)]
        ahead = pin.centerOfMass(model, data, q)[0] - above
        bent = np.mean([sign * q[7 + k] + angle for k, sign, angle in bends])
        width = WIDTH_WEIGHT * (y1 - y2 - wide)
        return np.concatenate([[ahead, bent - knee, x1, x2, z1, z2, y1 + y2], *tilts, [width]])

    low = model.lowerPositionLimit[legs]
    high = model.upperPositionLimit[legs]
    room = np.minimum(STANCE_ROOM_RAD, (high - low) / 3)
    ends = [[-np.inf, -np.inf, *(low + room)], [np.inf, np.inf, *(high - room)]]
    begin = [0.0, -first[:, 2].mean(), *q[legs]]
    begin = np.clip(begin, np.add(ends[0], 1e-9), np.subtract(ends[1], 1e-9))
    solved = least_squares(missing, begin, bounds=ends, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    worst = np.abs(missing(solved.x)[:-1]).max()
    if worst > STANDS_M:
        raise robot.error(
            f"with the knees at {knee:g} rad and the trunk at {trunk:g} rad no posture stands on "
            f"flat feet below the CoM: the nearest is {1e3 * worst:.0f} mm or mrad off, at most "
            f"{1e3 * STANDS_M:g}; {CHANGE_STANCE}"
        )
    return q


def holding(robot: Robot, q: np.ndarray, friction: float) -> tuple[float, str, float] | None:
    """Least effort of the joints that holds a posture ``q`` (nq,) whose soles are on the ground,
    under the robot's gravity.

    The ground's forces on the corners of both soles, within friction, are shared out so that the
    joint that uses most of its effort uses as little as can be. Returns that share [1], the joint,
    and its torque [N m]; None if no forces of the ground balance the posture.
    """
    from scipy.optimize import linprog  # slow to import

    model = robot.model
    data = posed(model, q)
    weight = pin.computeGeneralizedGravity(model, data, q)
    level = friction / np.sqrt(2)
    edges = np.array([[x, y, 1.0] for x in (-level, level) for y in (-level, level)])
    anchors = [on_feet(robot, corner)[side] for side in (0, 1) for corner in robot.foot.corners]
    slopes = [anchor.slope(model, data)[:3] for anchor in anchors]
    pushed = np.concatenate([edges @ slope for slope in slopes]).T
    effort = robot.limits.effort
    cost = np.append(np.zeros(pushed.shape[1]), 1.0)
    rows = np.block([[-pushed[6:], -effort[:, None]], [pushed[6:], -effort[:, None]]])
    base = np.hstack([pushed[:6], np.zeros((6, 1))])
    solved = linprog(cost, rows, np.concatenate([-weight[6:], weight[6:]]), base, weight[:6])
    if not solved.success:
        return None
    torque = weight[6:] - pushed[6:] @ solved.x[:-1]
    most = int(np.argmax(np.abs(torque) / effort))
    return float(solved.x[-1]), robot.joint_names[most], float(abs(torque[most]))


def check_held(robot: Robot, q: np.ndarray, friction: float = FRICTION) -> None:
    """Refuse (:class:`InfeasibleError`) a robot whose joints cannot hold a posture ``q`` (nq,), see
    :func:`holding`.
    """
    share, joint, torque = holding(robot, q, friction) or (0.0, "", 0.0)
    if share > 1:
        raise InfeasibleError(
            f"robot {robot.name} cannot hold the posture in which it begins: however the ground's "
            f"forces are shared, joint {joint} needs {share:.1f} times its effort, "
            f"{torque:.3g} N m of {robot.actuators[joint]['effort']:.3g}; if these are motors' "
            f"efforts before their gears, give those of the joints in [limits]"
        )
