"""What the robot can do, as stage 1 needs to know it: leg length, inertia and leg force within reach.

Postures of the sagittal model are sampled (a fixed low-discrepancy sequence, so the result is the same every time),
those outside the joint ranges are dropped, and the extremes over each CoM distance give smooth envelopes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from jumplab.robot.description import Robot
from jumplab.robot.sagittal import SAGITTAL_JOINTS
from jumplab.robot.stance import stance_angles

SAMPLES = 2**16  # our choice: envelopes move by less than 1 % when doubled
BINS = 24  # our choice: about 2 cm of CoM distance each
EDGE = (
    0.02  # our choice: share of extreme samples cut off on either side, so that the envelope is not a singular posture
)
HEEL_UP_RAD = 0.5  # our choice: foot pitch considered as still pushing off
TRUNK_RAD = (-0.30, 1.30)  # our choice: backward lean that looks like falling; forward lean of a deep bow
COM_X_M = (-0.10, 0.32)  # our choice: from behind the middle of the sole to the lean of a long jump at take-off
FORCE_SHARE = 0.85  # our choice: share of the peak torques that stage 1 may count on
STANCE_SHARE = 0.08  # our choice: the stance lies at least this share of the inertia envelope's width inside it
MIN_FORCE_LEVER_M = 0.04  # our choice: a joint closer than this to the force line does not limit it
FLAT_COM_X_M = (-0.02, 0.13)  # our choice: where the CoM is while the feet are flat
TOE_COM_X_M = (0.05, 0.25)  # our choice: where the CoM is while the heels are up
TOE_HEEL_UP_RAD = 0.9  # our choice: as stage 3 allows
EASY_ARM_RAD = 1.0  # our choice: arms that swing but do not reach
LOW_COM_QUANTILE = 0.003  # our choice: not the deepest squat that exists
EASY_COM_QUANTILE = 0.05  # our choice: below, hardly a posture keeps the hip off its stop
FORCE_CAP = 1.5  # our choice: nearly straight legs carry any load; the fit shall not chase that
SPEED_QUANTILE = 0.98  # our choice: as for the force; a good posture for extending the leg fast
# degree, coefficients and first directions of the primitive polynomials of Sobol's sequence, by S. Joe and F. Y. Kuo
SOBOL = ((1, 0, (1,)), (2, 1, (1, 3)), (3, 1, (1, 3, 1)), (3, 2, (1, 1, 1)))
SOBOL_BITS = 30


@dataclass(frozen=True)
class Reach:
    """Envelopes over the CoM's distance from the middle of the sole (phi).

    Attributes
    ----------
    length : (lower, upper) of phi [m].
    length_grid, inertia_low, inertia_high, force_high, speed_high : sampled envelopes over phi [m]: pitch inertia
        [kg m^2], vertical force at which a leg joint saturates [N], rate of phi at which a leg joint reaches its speed
        limit while the trunk does not turn [m/s].
    inertia_low_fit, inertia_high_fit, force_fit, speed_fit : polynomial coefficients over phi, highest power first.
    usual_flat_fit, usual_toe_fit : quadratic coefficients of the inertia that flat-footed and heel-up postures usually
        have at phi.
    low_com_fit, easy_com_fit : (slope, offset) of the lowest CoM height over its x with flat feet [m], and of the one
        above which hip and ankle are away from their stops.
    inertia : overall (lower, upper) of the pitch inertia, in any reachable posture [kg m^2].
    internal_inertia : constant part rho_I [kg m^2].
    cop : (heel, toe) from the middle of the sole [m].
    posture : (lower, upper) trunk pitch [rad].
    weakest : "force" and "speed" -> the leg joint that saturates first where the leg extends best, with its limit.
    start : lean, length, turn, radius of the stance (theta_l, phi, theta_pl, varphi).
    mass : of the whole robot [kg].
    """

    length: tuple[float, float]
    length_grid: np.ndarray
    inertia_low: np.ndarray
    inertia_high: np.ndarray
    force_high: np.ndarray
    speed_high: np.ndarray
    inertia_low_fit: np.ndarray
    inertia_high_fit: np.ndarray
    force_fit: np.ndarray
    speed_fit: np.ndarray
    usual_flat_fit: np.ndarray
    usual_toe_fit: np.ndarray
    low_com_fit: np.ndarray
    easy_com_fit: np.ndarray
    inertia: tuple[float, float]
    internal_inertia: float
    cop: tuple[float, float]
    posture: tuple[float, float]
    start: np.ndarray
    mass: float
    weakest: dict


def _turned(angle, vector):
    return _along((np.cos(angle), np.sin(angle)), vector)


def _along(turn, vector):
    c, s = turn
    return np.stack([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1]], -1)


@cache
def sobol(count: int) -> np.ndarray:
    """The first ``count`` points (count, 5) in [0, 1) of Sobol's sequence, read-only.

    The same numbers as scipy.stats.qmc.Sobol(5, scramble=False), whose import takes longer than all of this module.
    """
    directions = np.empty((5, SOBOL_BITS), np.int64)
    directions[0] = 1 << np.arange(SOBOL_BITS - 1, -1, -1)
    for row, (degree, coefficients, first) in zip(directions[1:], SOBOL, strict=True):
        m = list(first)
        for k in range(degree, SOBOL_BITS):
            new = m[k - degree] ^ (m[k - degree] << degree)
            for i in range(1, degree):
                new ^= ((coefficients >> (degree - 1 - i)) & 1) * (m[k - i] << i)
            m.append(new)
        row[:] = [x << (SOBOL_BITS - 1 - k) for k, x in enumerate(m)]
    index = np.arange(count)
    gray, points = index ^ (index >> 1), np.zeros((count, 5), np.int64)
    for k in range(max(count - 1, 1).bit_length()):
        points ^= ((gray >> k) & 1)[:, None] * directions[:, k]
    unit = points / 2.0**SOBOL_BITS
    unit.setflags(write=False)
    return unit


def postures(
    robot: Robot, count: int = SAMPLES, heel_up_rad: float = HEEL_UP_RAD, com_x_m: tuple[float, float] = COM_X_M,
    *, strength: bool = True,
) -> dict:  # fmt: skip
    """Sampled postures within joint ranges, toe on the ground, heel up by at most ``heel_up_rad``.

    Returns arrays angles (n, 5), com (n, 2) from mid-sole, shoulder, rho; with ``strength`` also force and speed, and
    the joints that limit them.
    """
    m = robot.sagittal
    unit = sobol(count)
    foot, trunk = unit[:, 0] * heel_up_rad, TRUNK_RAD[0] + unit[:, 1] * (TRUNK_RAD[1] - TRUNK_RAD[0])
    joints = m.lower + unit[:, 2:][:, [0, 1, 1, 2]] * (m.upper - m.lower)
    hip, knee, shoulder = joints[:, 0], joints[:, 1], joints[:, 3]
    angles = np.stack([foot, trunk + hip + knee, trunk + hip, trunk, trunk + shoulder], -1)  # (n, 5)
    ankle = angles[:, 0] - angles[:, 1]
    com_arms, mass = m.com_arms(), m.mass
    turn = [(np.cos(x), np.sin(x)) for x in angles.T]
    links = np.stack([sum(_along(turn[j], com_arms[i, j]) for j in range(5)) for i in range(5)], 1)  # (n, 5, 2)
    com = np.einsum("i,nik->nk", mass, links) / mass.sum()
    rho = m.inertia.sum() + np.einsum("i,nik->n", mass, (links - com[:, None]) ** 2)
    from_sole = com - m.sole_center
    ok = (ankle > m.lower[2]) & (ankle < m.upper[2]) & (from_sole[:, 0] > com_x_m[0]) & (from_sole[:, 0] < com_x_m[1])
    ok &= from_sole[:, 1] > 0.15  # our choice: lower than this the robot sits
    columns = {"angles": angles, "com": from_sole, "shoulder": shoulder, "rho": rho}
    found = {name: x[ok] for name, x in columns.items()}
    if strength:
        found["force"], found["force_joint"] = _static_force(m, found["angles"], com[ok])
        found["speed"], found["speed_joint"] = _extension_speed(m, found["angles"], found["com"])
    return found


def _usual_inertia(p: dict) -> np.ndarray:
    """Quadratic fit of rho over phi through postures with easy arms."""
    easy = np.abs(p["shoulder"]) < EASY_ARM_RAD
    return np.polyfit(np.linalg.norm(p["com"][easy], axis=1), p["rho"][easy], 2)


def _lowest_com(p: dict, quantile: float) -> np.ndarray:
    """Straight line z = a x + b below which only that share of flat-footed postures lies, highest power first."""
    x, z = p["com"].T
    edges = np.linspace(*FLAT_COM_X_M, 9)  # our choice: about 2 cm each
    low = [np.quantile(z[(x >= a) & (x < b)], quantile) for a, b in pairwise(edges)]
    return np.polyfit((edges[1:] + edges[:-1]) / 2, low, 1)


def _static_force(m, angles, com):
    """Vertical force [N] at which the first leg joint saturates, CoP below the CoM but inside the sole; and which."""
    at = np.cumsum([_turned(angles[:, j], m.span[j]) for j in range(3)], axis=0)[..., 0]  # ankle, knee, hip x (3, n)
    cop = np.clip(com[:, 0], m.heel[0], 0.0)
    levers = np.maximum(np.abs(at - cop), MIN_FORCE_LEVER_M)
    carried = m.effort[[2, 1, 0]][:, None] / levers
    return FORCE_SHARE * np.min(carried, axis=0), 2 - np.argmin(carried, axis=0)


def _extension_speed(m, angles, com):
    """Rate of phi [m/s] at which ankle, knee or hip reaches its speed limit, and which: foot and trunk still."""
    arms = np.einsum("i,ijk->jk", m.mass, m.com_arms()) / m.total_mass
    along = com / np.linalg.norm(com, axis=1, keepdims=True)
    turned = [_turned(angles[:, j], arms[j]) for j in (1, 2)]  # shank, thigh
    (a, c), (b, d) = ((x[:, 1], -x[:, 0]) for x in turned)
    det = a * d - b * c
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)  # straight leg: no speed at all
    shank, thigh = (d * along[:, 0] - b * along[:, 1]) / det, (a * along[:, 1] - c * along[:, 0]) / det
    used = np.abs([shank / m.speed[2], (shank - thigh) / m.speed[1], thigh / m.speed[0]])
    return 1.0 / np.max(used, axis=0), 2 - np.argmax(used, axis=0)


def _weakest(m, p: dict, phi: np.ndarray) -> dict:
    """The joint that most often saturates in the best postures of the leg's stroke, for force and for speed."""
    out, upper = {}, phi > np.median(phi)
    for what, unit, limits in (("force", "N m", m.effort), ("speed", "rad/s", m.speed)):
        best = p[what][upper] >= np.quantile(p[what][upper], 0.5)
        joint = int(np.bincount(p[f"{what}_joint"][upper][best], minlength=3).argmax())
        out[what] = f"{SAGITTAL_JOINTS[joint]} {limits[joint]:.3g} {unit}"
    return out


def _around_stance(lower: np.ndarray, upper: np.ndarray, length: float, inertia: float):
    """The two fits, shifted where needed so that the jump's first posture lies inside them.

    Without arms that swing the envelope is narrow, and a stance that is a corner of it can be cut off.
    """
    low, high = np.polyval(lower, length), np.polyval(upper, length)
    share = (inertia - low) / (high - low)
    if share < STANCE_SHARE:
        lower = lower - np.append(np.zeros(len(lower) - 1), (STANCE_SHARE - share) * (high - low) / (1 - STANCE_SHARE))
    elif share > 1 - STANCE_SHARE:
        excess = (share - 1 + STANCE_SHARE) * (high - low) / (1 - STANCE_SHARE)
        upper = upper + np.append(np.zeros(len(upper) - 1), excess)
    return lower, upper


def _rod(m, angles: np.ndarray) -> tuple[np.ndarray, float]:
    """Lean, length, turn and radius (4,) of stage 1's rod in a posture with flat feet, and its inertia."""
    arms, mass = m.com_arms(), m.mass
    links = np.array([sum(_turned(angles[j], arms[i, j]) for j in range(5)) for i in range(5)])
    com = mass @ links / mass.sum()
    from_sole = com - m.sole_center
    rho = m.inertia.sum() + mass @ np.sum((links - com) ** 2, axis=1)
    return np.array([np.arctan2(*from_sole), np.hypot(*from_sole), angles[3], np.sqrt(rho / mass.sum())]), rho


def rod_of(robot: Robot, angles: np.ndarray) -> np.ndarray:
    """Lean, length, turn, radius (4,) of stage 1's rod for absolute link angles (5,) of a posture with flat feet."""
    return _rod(robot.sagittal, angles)[0]


def reach(robot: Robot, count: int = SAMPLES) -> Reach:
    """Sample the robot and fit its envelopes (Sec. III: "proper range respecting to the actual robot")."""
    m, p = robot.sagittal, postures(robot, count)
    phi, rho, force, speed = np.linalg.norm(p["com"], axis=1), p["rho"], p["force"], p["speed"]
    low, high = np.quantile(phi, [EDGE / 10, 1 - EDGE / 10])
    edges = np.linspace(low, high, BINS + 1)
    grid = (edges[1:] + edges[:-1]) / 2
    rows = []
    for a, b in pairwise(edges):
        inside = (phi >= a) & (phi < b)
        rows.append([*np.quantile(rho[inside], [EDGE, 1 - EDGE]), np.quantile(force[inside], 1 - EDGE),
                     np.quantile(speed[inside], SPEED_QUANTILE)])  # fmt: skip
    lower, upper, strongest, fastest = np.array(rows).T
    start, stance_rho = _rod(m, stance_angles(robot))
    mass = m.mass
    half = -m.heel[0] / 2
    flat = postures(robot, count, 0.0, FLAT_COM_X_M, strength=False)
    toe = postures(robot, count, TOE_HEEL_UP_RAD, TOE_COM_X_M, strength=False)
    capped = np.minimum(strongest, FORCE_CAP * strongest[0])
    curves = ((capped, 3), (fastest, 3))
    envelope = _around_stance(np.polyfit(grid, lower, 2), np.polyfit(grid, upper, 2), start[1], stance_rho)
    return Reach(
        (float(low), float(high)), grid, lower, upper, strongest, fastest,
        *envelope, *(np.polyfit(grid, values, degree) for values, degree in curves),
        _usual_inertia(flat), _usual_inertia(toe), _lowest_com(flat, LOW_COM_QUANTILE),
        _lowest_com(flat, EASY_COM_QUANTILE),
        (float(lower.min()), float(upper.max())), float(m.inertia.sum()), (-half, half), TRUNK_RAD, start,
        float(mass.sum()), _weakest(m, p, phi),
    )  # fmt: skip
