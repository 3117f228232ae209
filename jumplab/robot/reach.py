"""Abilities of the robot as stage 1 needs them: leg length, inertia and leg force within reach.

Postures of the sagittal model are sampled (a low-discrepancy sequence, the same every time), those
outside the joint ranges are dropped, and the extremes over each CoM distance phi give smooth
envelopes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from jumplab.robot.description import Robot
from jumplab.robot.legs import size
from jumplab.robot.sagittal import TO_COMPLEX, SagittalModel
from jumplab.robot.stance import stance_angles

# which postures are sampled, and how the envelopes are drawn around them; the paper prints none
# of this; lengths are the default robot's, scaled for others by their legs
SAMPLES = 2**16  # twice as many move the envelopes by less than 1 %
TRUNK_RAD = (-0.30, 1.30)  # a backward lean that looks like falling; a deep bow
HEEL_UP_RAD = 0.5  # foot pitch that still pushes off
TOE_HEEL_UP_RAD = 0.9  # foot pitch while the heels are up, as stage 3 allows
COM_X_M = (-0.10, 0.32)  # behind the middle of the sole; lean of a long jump at take-off
FLAT_COM_X_M = (-0.02, 0.13)  # where the CoM is while the feet are flat
TOE_COM_X_M = (0.05, 0.25)  # where the CoM is while the heels are up
LOWEST_COM_M = 0.15  # lower than this the robot sits
EASY_ARM_RAD = 1.0  # arms that swing but do not reach
BINS = 24  # about 2 cm of CoM distance each
COM_BINS = 8  # about 2 cm of the flat feet's CoM range each
EDGE = 0.02  # [1] share of samples cut off at either end: no envelope of singular postures
LOW_COM_QUANTILE = 0.003  # [1] not the deepest squat that exists
EASY_COM_QUANTILE = 0.05  # [1] below, hardly a posture keeps the hip off its stop
SPEED_QUANTILE = 0.98  # [1] as for the force; a good posture for extending the leg fast
FORCE_SHARE = 0.85  # [1] share of the peak torques that stage 1 may count on
FORCE_CAP = 1.5  # [1] times the force of the bent leg: nearly straight legs carry any load
LEAST_LEVER_M = 0.04  # a joint closer than this to the force line does not limit it
STANCE_SHARE = 0.08  # [1] least depth of the stance inside the inertia envelope, of its width


@dataclass(frozen=True)
class Reach:
    """Envelopes over the CoM's distance phi from mid-sole; fits have the highest power first."""

    length: tuple[float, float]  # lower, upper phi [m]
    inertia_low_fit: np.ndarray  # pitch inertia [kg m^2]
    inertia_high_fit: np.ndarray
    force_fit: np.ndarray  # vertical force at which a leg joint saturates [N]
    # rate of phi at which a leg joint is at its speed limit, the trunk not turning [m/s]
    speed_fit: np.ndarray
    usual_flat_fit: np.ndarray  # inertia that flat-footed postures usually have at phi
    usual_toe_fit: np.ndarray  # and heel-up ones
    # (slope, offset) of the lowest CoM height over its x with flat feet [m]
    low_com_fit: np.ndarray
    easy_com_fit: np.ndarray  # likewise, above which hip and ankle are away from their stops
    inertia: tuple[float, float]  # lower, upper of any reachable posture [kg m^2]
    cop: tuple[float, float]  # heel, toe from the middle of the sole [m]
    posture: tuple[float, float]  # lower, upper trunk pitch [rad]
    start: np.ndarray  # lean, length, turn, radius of the stance (theta_l, phi, theta_pl, varphi)
    mass: float  # of the whole robot [kg]


def postures(
    robot: Robot,
    count: int = SAMPLES,
    heel_up_rad: float = HEEL_UP_RAD,
    com_x_m: tuple[float, float] = COM_X_M,
    *,
    strength: bool = True,
) -> dict[str, np.ndarray]:
    """Sampled postures within joint ranges, toe on the ground, heel up by at most ``heel_up_rad``,
    the CoM ahead of mid-sole within ``com_x_m`` (scaled by the legs).

    Returns arrays angles (n, 5) [rad], com (n, 2) from mid-sole [m], shoulder [rad], rho [kg m^2];
    with ``strength`` also force [N] and speed [m/s] at which the first leg joint saturates.
    """
    from scipy.stats import qmc  # its import takes longer than what it does here

    m = robot.sagittal
    metres = partial(size(robot).of, unit="m")
    (low, high) = TRUNK_RAD
    unit = qmc.Sobol(5, scramble=False).random(count)
    foot = unit[:, 0] * heel_up_rad
    trunk = low + unit[:, 1] * (high - low)
    hip, knee, _, shoulder = (m.lower + unit[:, [2, 3, 3, 4]] * (m.upper - m.lower)).T
    # (n, 5)
    angles = np.stack([foot, trunk + hip + knee, trunk + hip, trunk, trunk + shoulder], -1)
    ankle = angles[:, 0] - angles[:, 1]
    ok = (ankle > m.lower[2]) & (ankle < m.upper[2])
    angles = angles[ok]
    shoulder = shoulder[ok]
    com, rho = _com_inertia(m, angles)
    x, z = com.T
    low, high = map(metres, com_x_m)
    ok = (z > metres(LOWEST_COM_M)) & (x > low) & (x < high)
    columns = {"angles": angles, "com": com, "shoulder": shoulder, "rho": rho}
    inside = {name: x[ok] for name, x in columns.items()}
    if strength:
        at = (m, inside["angles"], inside["com"])
        inside["force"] = 1 / _force_shares(*at, metres(LEAST_LEVER_M)).max(axis=0)
        inside["speed"] = 1 / _speed_shares(*at).max(axis=0)
    return inside


def _com_inertia(m: SagittalModel, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """CoM (..., 2) from mid-sole [m], pitch inertia (...) [kg m^2] at angles (..., 5)."""
    links = m.link_coms(angles)
    com = m.mass @ links / m.total_mass
    away = np.sum((links - com[..., None, :]) ** 2, axis=-1)
    return com - m.sole_center, m.inertia.sum() + away @ m.mass


def _force_shares(
    m: SagittalModel, angles: np.ndarray, com: np.ndarray, least_m: float
) -> np.ndarray:
    """Shares of ankle, knee, hip (3, n) that a force up takes [1/N], CoP below the CoM, by levers
    of at least ``least_m`` [m].
    """
    turned = np.exp(-1j * angles[:, :3]) * (m.span[:3] @ TO_COMPLEX)
    at = np.cumsum(turned, axis=1).real.T  # of the joints, ahead of the toe
    cop = np.clip(com[:, 0] + m.sole_center[0], m.heel[0], 0.0)
    levers = np.maximum(np.abs(at - cop), least_m)
    return levers / (FORCE_SHARE * m.effort[[2, 1, 0], None])


def _speed_shares(m: SagittalModel, angles: np.ndarray, com: np.ndarray) -> np.ndarray:
    """Shares of their speeds ankle, knee, hip (3, n) take for a rate of phi [s/m]."""
    way = com @ TO_COMPLEX
    way = way / np.abs(way)
    shank, thigh = (-1j * np.exp(-1j * angles[:, [1, 2]]) * m.mean_arms[[1, 2]]).T  # CoM per rate
    det = np.imag(np.conj(shank) * thigh)
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)  # straight leg: no speed at all
    shank_rate = np.imag(np.conj(way) * thigh) / det
    thigh_rate = np.imag(np.conj(shank) * way) / det
    rates = np.array([shank_rate, shank_rate - thigh_rate, thigh_rate])
    return np.abs(rates) / m.speed[[2, 1, 0], None]


def _usual_inertia(p: dict[str, np.ndarray]) -> np.ndarray:
    """Quadratic fit of rho over phi through postures with easy arms."""
    easy = np.abs(p["shoulder"]) < EASY_ARM_RAD
    return np.polyfit(np.linalg.norm(p["com"][easy], axis=1), p["rho"][easy], 2)


def _lowest_com(p: dict[str, np.ndarray], edges: np.ndarray, quantile: float) -> np.ndarray:
    """Line z = a x + b, as (a, b), below which only that share of flat-footed postures lies, in the
    bins between ``edges`` (n,) [m] that have any.
    """
    x, z = p["com"].T
    bins = {(a + b) / 2: z[(x >= a) & (x < b)] for a, b in pairwise(edges)}
    low = {middle: np.quantile(z, quantile) for middle, z in bins.items() if len(z)}
    return np.polyfit([*low], [*low.values()], 1)


def _around_stance(lower: np.ndarray, upper: np.ndarray, length: float, inertia: float):
    """The two fits, the constant term shifted where needed so that the jump's first posture lies
    inside them.

    Without arms that swing the envelope is narrow, and a stance that is a corner of it can be cut
    off.
    """
    low = np.polyval(lower, length)
    high = np.polyval(upper, length)
    least = STANCE_SHARE
    share = (inertia - low) / (high - low)
    lower[-1] -= max(least - share, 0.0) * (high - low) / (1 - least)
    upper[-1] += max(share - 1 + least, 0.0) * (high - low) / (1 - least)
    return lower, upper


def rod_of(robot: Robot, angles: np.ndarray) -> np.ndarray:
    """Stage 1's lean, length, turn, radius (4,) at link angles (5,) with flat feet."""
    (x, z), rho = _com_inertia(robot.sagittal, angles)
    radius = np.sqrt(rho / robot.sagittal.total_mass)
    return np.array([np.arctan2(x, z), np.hypot(x, z), angles[3], radius])


def reach(robot: Robot, count: int = SAMPLES) -> Reach:
    """Sample the robot and fit its envelopes (Sec. III: "proper range respecting to the actual
    robot").
    """
    m = robot.sagittal
    p = postures(robot, count)
    phi = np.linalg.norm(p["com"], axis=1)
    low, high = np.quantile(phi, [EDGE / 10, 1 - EDGE / 10])
    edges = np.linspace(low, high, BINS + 1)
    grid = (edges[1:] + edges[:-1]) / 2
    inside = [(phi >= a) & (phi < b) for a, b in pairwise(edges)]

    def envelope(name: str, share: float) -> np.ndarray:
        return np.array([np.quantile(p[name][i], share) for i in inside])

    lower = envelope("rho", EDGE)
    upper = envelope("rho", 1 - EDGE)
    force = envelope("force", 1 - EDGE)
    speed = envelope("speed", SPEED_QUANTILE)
    bins = size(robot).of(np.linspace(*FLAT_COM_X_M, COM_BINS + 1), "m")
    flat = postures(robot, count, 0.0, FLAT_COM_X_M, strength=False)
    toe = postures(robot, count, TOE_HEEL_UP_RAD, TOE_COM_X_M, strength=False)
    start = rod_of(robot, stance_angles(robot))
    fits = _around_stance(
        np.polyfit(grid, lower, 2),
        np.polyfit(grid, upper, 2),
        start[1],
        m.total_mass * start[3] ** 2,
    )
    return Reach(
        length=(float(low), float(high)),
        inertia_low_fit=fits[0],
        inertia_high_fit=fits[1],
        force_fit=np.polyfit(grid, np.minimum(force, FORCE_CAP * force[0]), 3),
        speed_fit=np.polyfit(grid, speed, 3),
        usual_flat_fit=_usual_inertia(flat),
        usual_toe_fit=_usual_inertia(toe),
        low_com_fit=_lowest_com(flat, bins, LOW_COM_QUANTILE),
        easy_com_fit=_lowest_com(flat, bins, EASY_COM_QUANTILE),
        inertia=(float(lower.min()), float(upper.max())),
        cop=(float(m.heel[0]) / 2, float(-m.heel[0]) / 2),
        posture=TRUNK_RAD,
        start=start,
        mass=m.total_mass,
    )
