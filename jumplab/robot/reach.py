"""What the robot can do, as stage 1 needs to know it: leg length, inertia and leg force within reach.

Postures of the sagittal model are sampled (a low-discrepancy sequence, the same every time), those outside the joint
ranges are dropped, and the extremes over each CoM distance phi give smooth envelopes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.robot.description import Robot
from jumplab.robot.sagittal import SAGITTAL_JOINTS, SagittalModel, rotated
from jumplab.robot.stance import stance_angles


@dataclass(frozen=True)
class ReachSettings:
    """Which postures are sampled, and how the envelopes are drawn around them; the paper prints none of this."""

    samples: int = 2**16  # twice as many move the envelopes by less than 1 %
    trunk_rad: tuple[float, float] = (-0.30, 1.30)  # a backward lean that looks like falling; a deep bow
    heel_up_rad: float = 0.5  # foot pitch that still pushes off
    toe_heel_up_rad: float = 0.9  # foot pitch while the heels are up, as stage 3 allows
    com_x_m: tuple[float, float] = (-0.10, 0.32)  # behind the middle of the sole; lean of a long jump at take-off
    flat_com_x_m: tuple[float, float] = (-0.02, 0.13)  # where the CoM is while the feet are flat
    toe_com_x_m: tuple[float, float] = (0.05, 0.25)  # where the CoM is while the heels are up
    lowest_com_m: float = 0.15  # lower than this the robot sits
    easy_arm_rad: float = 1.0  # arms that swing but do not reach
    bins: int = 24  # about 2 cm of CoM distance each
    com_bins: int = 8  # about 2 cm of the flat feet's CoM range each
    edge: float = 0.02  # [1] share of samples cut off at either end: no envelope of singular postures
    low_com_quantile: float = 0.003  # [1] not the deepest squat that exists
    easy_com_quantile: float = 0.05  # [1] below, hardly a posture keeps the hip off its stop
    speed_quantile: float = 0.98  # [1] as for the force; a good posture for extending the leg fast
    force_share: float = 0.85  # [1] share of the peak torques that stage 1 may count on
    force_cap: float = 1.5  # [1] times the force of the bent leg: nearly straight legs carry any load
    least_lever_m: float = 0.04  # a joint closer than this to the force line does not limit it
    stance_share: float = 0.08  # [1] least depth of the stance inside the inertia envelope, of its width


SETTINGS = ReachSettings()
SHIPPED_REACH = Path(__file__).parent / "bhr" / "reach.json"


@dataclass(frozen=True)
class Reach:
    """Envelopes over the CoM's distance phi from the middle of the sole; fits are polynomials, highest power first."""

    length: tuple[float, float]  # lower, upper phi [m]
    length_grid: np.ndarray  # phi of the four sampled envelopes that follow [m]
    inertia_low: np.ndarray  # pitch inertia [kg m^2]
    inertia_high: np.ndarray
    force_high: np.ndarray  # vertical force at which a leg joint saturates [N]
    speed_high: np.ndarray  # rate of phi at which a leg joint is at its speed limit, the trunk not turning [m/s]
    inertia_low_fit: np.ndarray
    inertia_high_fit: np.ndarray
    force_fit: np.ndarray
    speed_fit: np.ndarray
    usual_flat_fit: np.ndarray  # inertia that flat-footed postures usually have at phi
    usual_toe_fit: np.ndarray  # and heel-up ones
    low_com_fit: np.ndarray  # (slope, offset) of the lowest CoM height over its x with flat feet [m]
    easy_com_fit: np.ndarray  # likewise, above which hip and ankle are away from their stops
    inertia: tuple[float, float]  # lower, upper of any reachable posture [kg m^2]
    internal_inertia: float  # constant part rho_I [kg m^2]
    cop: tuple[float, float]  # heel, toe from the middle of the sole [m]
    posture: tuple[float, float]  # lower, upper trunk pitch [rad]
    start: np.ndarray  # lean, length, turn, radius of the stance (theta_l, phi, theta_pl, varphi)
    mass: float  # of the whole robot [kg]
    weakest: dict[str, str]  # "force", "speed" -> leg joint that saturates first where the leg extends best, its limit

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in vars(self).items()}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Reach:
        """The envelopes that :meth:`to_json` told."""
        kinds = {"np.ndarray": np.array, "tuple[float, float]": tuple}
        return cls(**{f.name: kinds.get(str(f.type), lambda x: x)(data[f.name]) for f in fields(cls)})


def postures(
    robot: Robot,
    count: int = SETTINGS.samples,
    heel_up_rad: float = SETTINGS.heel_up_rad,
    com_x_m: tuple[float, float] = SETTINGS.com_x_m,
    *,
    strength: bool = True,
) -> dict[str, np.ndarray]:
    """Sampled postures within joint ranges, toe on the ground, heel up by at most ``heel_up_rad``.

    Returns arrays angles (n, 5) [rad], com (n, 2) from mid-sole [m], shoulder [rad], rho [kg m^2]; with ``strength``
    also force [N] and speed [m/s], and the joints that limit them.
    """
    from scipy.stats import qmc  # its import takes longer than what it does here

    m, (low, high) = robot.sagittal, SETTINGS.trunk_rad
    unit = qmc.Sobol(5, scramble=False).random(count)
    foot, trunk = unit[:, 0] * heel_up_rad, low + unit[:, 1] * (high - low)
    hip, knee, _, shoulder = (m.lower + unit[:, [2, 3, 3, 4]] * (m.upper - m.lower)).T
    angles = np.stack([foot, trunk + hip + knee, trunk + hip, trunk, trunk + shoulder], -1)  # (n, 5)
    ankle = angles[:, 0] - angles[:, 1]
    links = m.link_coms(angles)
    com = np.einsum("i,nik->nk", m.mass, links) / m.mass.sum()
    rho = m.inertia.sum() + np.einsum("i,nik->n", m.mass, (links - com[:, None]) ** 2)
    from_sole = com - m.sole_center
    ok = (ankle > m.lower[2]) & (ankle < m.upper[2]) & (from_sole[:, 1] > SETTINGS.lowest_com_m)
    ok &= (from_sole[:, 0] > com_x_m[0]) & (from_sole[:, 0] < com_x_m[1])
    columns = {"angles": angles, "com": from_sole, "shoulder": shoulder, "rho": rho}
    found = {name: x[ok] for name, x in columns.items()}
    if strength:
        found["force"], found["force_joint"] = _static_force(m, found["angles"], com[ok])
        found["speed"], found["speed_joint"] = _extension_speed(m, found["angles"], found["com"])
    return found


def _static_force(m: SagittalModel, angles: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertical force [N] at which the first leg joint saturates, CoP below the CoM but inside the sole; and which."""
    at = np.cumsum([rotated(angles[:, j], m.span[j]) for j in range(3)], axis=0)[..., 0]  # ankle, knee, hip x (3, n)
    cop = np.clip(com[:, 0], m.heel[0], 0.0)
    levers = np.maximum(np.abs(at - cop), SETTINGS.least_lever_m)
    carried = m.effort[[2, 1, 0]][:, None] / levers
    return SETTINGS.force_share * np.min(carried, axis=0), 2 - np.argmin(carried, axis=0)


def _extension_speed(m: SagittalModel, angles: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of phi [m/s] at which ankle, knee or hip reaches its speed limit, and which: foot and trunk still."""
    arms = np.einsum("i,ijk->jk", m.mass, m.com_arms()) / m.total_mass
    along = com / np.linalg.norm(com, axis=1, keepdims=True)
    turned = [rotated(angles[:, j], arms[j]) for j in (1, 2)]  # shank, thigh
    (a, c), (b, d) = ((x[:, 1], -x[:, 0]) for x in turned)
    det = a * d - b * c
    det = np.where(np.abs(det) < 1e-6, 1e-6, det)  # straight leg: no speed at all
    shank, thigh = (d * along[:, 0] - b * along[:, 1]) / det, (a * along[:, 1] - c * along[:, 0]) / det
    used = np.abs([shank / m.speed[2], (shank - thigh) / m.speed[1], thigh / m.speed[0]])
    return 1.0 / np.max(used, axis=0), 2 - np.argmax(used, axis=0)


def _usual_inertia(p: dict[str, np.ndarray]) -> np.ndarray:
    """Quadratic fit of rho over phi through postures with easy arms."""
    easy = np.abs(p["shoulder"]) < SETTINGS.easy_arm_rad
    return np.polyfit(np.linalg.norm(p["com"][easy], axis=1), p["rho"][easy], 2)


def _lowest_com(p: dict[str, np.ndarray], quantile: float) -> np.ndarray:
    """Straight line z = a x + b below which only that share of flat-footed postures lies, highest power first."""
    x, z = p["com"].T
    edges = np.linspace(*SETTINGS.flat_com_x_m, SETTINGS.com_bins + 1)
    low = [np.quantile(z[(x >= a) & (x < b)], quantile) for a, b in pairwise(edges)]
    return np.polyfit((edges[1:] + edges[:-1]) / 2, low, 1)


def _weakest(m: SagittalModel, p: dict[str, np.ndarray], phi: np.ndarray) -> dict[str, str]:
    """The joint that most often saturates in the best postures of the leg's stroke, for force and for speed."""
    out, upper = {}, phi > np.median(phi)
    for what, unit, limits in (("force", "N m", m.effort), ("speed", "rad/s", m.speed)):
        best = p[what][upper] >= np.quantile(p[what][upper], 0.5)
        joint = int(np.bincount(p[f"{what}_joint"][upper][best], minlength=3).argmax())
        out[what] = f"{SAGITTAL_JOINTS[joint]} {limits[joint]:.3g} {unit}"
    return out


def _around_stance(lower: np.ndarray, upper: np.ndarray, length: float, inertia: float):
    """The two fits, the constant term shifted where needed so that the jump's first posture lies inside them.

    Without arms that swing the envelope is narrow, and a stance that is a corner of it can be cut off.
    """
    low, high = np.polyval(lower, length), np.polyval(upper, length)
    least = SETTINGS.stance_share
    share = (inertia - low) / (high - low)
    lower[-1] -= max(least - share, 0.0) * (high - low) / (1 - least)
    upper[-1] += max(share - 1 + least, 0.0) * (high - low) / (1 - least)
    return lower, upper


def _rod(m: SagittalModel, angles: np.ndarray) -> tuple[np.ndarray, float]:
    """Lean, length, turn and radius (4,) of stage 1's rod in a posture with flat feet, and its inertia [kg m^2]."""
    links = m.link_coms(angles)
    com = m.mass @ links / m.mass.sum()
    rho = m.inertia.sum() + m.mass @ np.sum((links - com) ** 2, axis=1)
    x, z = com - m.sole_center
    return np.array([np.arctan2(x, z), np.hypot(x, z), angles[3], np.sqrt(rho / m.mass.sum())]), rho


def rod_of(robot: Robot, angles: np.ndarray) -> np.ndarray:
    """Lean, length, turn, radius (4,) of stage 1's rod for absolute link angles (5,) of a posture with flat feet."""
    return _rod(robot.sagittal, angles)[0]


def reach(robot: Robot, count: int = SETTINGS.samples) -> Reach:
    """Sample the robot and fit its envelopes (Sec. III: "proper range respecting to the actual robot")."""
    s, m, p = SETTINGS, robot.sagittal, postures(robot, count)
    phi, mass = np.linalg.norm(p["com"], axis=1), float(m.mass.sum())
    low, high = np.quantile(phi, [s.edge / 10, 1 - s.edge / 10])
    edges = np.linspace(low, high, s.bins + 1)
    grid = (edges[1:] + edges[:-1]) / 2
    inside = [(phi >= a) & (phi < b) for a, b in pairwise(edges)]
    wanted = (("rho", s.edge), ("rho", 1 - s.edge), ("force", 1 - s.edge), ("speed", s.speed_quantile))
    lower, upper, force, speed = (np.array([np.quantile(p[k][i], share) for i in inside]) for k, share in wanted)
    flat = postures(robot, count, 0.0, s.flat_com_x_m, strength=False)
    toe = postures(robot, count, s.toe_heel_up_rad, s.toe_com_x_m, strength=False)
    start, stance_rho = _rod(m, stance_angles(robot))
    fits = _around_stance(np.polyfit(grid, lower, 2), np.polyfit(grid, upper, 2), start[1], stance_rho)
    return Reach(
        length=(float(low), float(high)),
        length_grid=grid,
        inertia_low=lower,
        inertia_high=upper,
        force_high=force,
        speed_high=speed,
        inertia_low_fit=fits[0],
        inertia_high_fit=fits[1],
        force_fit=np.polyfit(grid, np.minimum(force, s.force_cap * force[0]), 3),
        speed_fit=np.polyfit(grid, speed, 3),
        usual_flat_fit=_usual_inertia(flat),
        usual_toe_fit=_usual_inertia(toe),
        low_com_fit=_lowest_com(flat, s.low_com_quantile),
        easy_com_fit=_lowest_com(flat, s.easy_com_quantile),
        inertia=(float(lower.min()), float(upper.max())),
        internal_inertia=float(m.inertia.sum()),
        cop=(float(m.heel[0]) / 2, float(-m.heel[0]) / 2),
        posture=s.trunk_rad,
        start=start,
        mass=mass,
        weakest=_weakest(m, p, phi),
    )


def shipped_reach(robot: Robot) -> Reach | None:
    """The envelopes of the default robot as they are shipped, those of any other robot None.

    ``python -m jumplab.robot.reach`` samples and writes them; a test holds them against :func:`reach`.
    """
    data = json.loads(SHIPPED_REACH.read_bytes())
    return Reach.from_json(data["reach"]) if data["robot_hash"] == robot.hash else None


if __name__ == "__main__":
    found = {"robot_hash": Robot.load().hash, "reach": reach(Robot.load()).to_json()}
    SHIPPED_REACH.write_text(json.dumps(found, indent=1) + "\n")
