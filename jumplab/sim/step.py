"""One recovery step: a foot is put to where the robot would come to rest, once that lies beyond both soles.

On soles that stand, a pendulum of the CoM's height z comes to rest over the capture point x + v sqrt(z / g). Pressure
cannot leave the soles, and so a capture point beyond them runs away, e-fold in each sqrt(z / g): only a foot elsewhere
ends it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull

from jumplab.robot import Robot
from jumplab.sim.estimator import SURE

if TYPE_CHECKING:
    from jumplab.sim.landing import BodyTerms

# The paper prints none of these numbers: it never steps.
SETTLED_S = 0.15  # after touchdown; before, the soles turn flat and the impact is not over
BEYOND_M, BEYOND_S = 0.01, 0.02  # the capture point this far beyond the soles, for so long
SWING_S = 0.24  # the foot's way; shorter asks for more than the hip has, longer lets the robot fall further
LIFT_M = 0.05  # of the sole, halfway
LEAST_S = 0.05  # a foot nearer to its end is not aimed any more
SINK = 0.3  # [m/s] at the end of its way, so that it meets ground that is lower too
FORWARD_M, ASIDE_M = (-0.45, 0.50), (0.15, 0.55)  # where the foot can go, from the middle of the other one
BESIDE_M = 0.03  # so much further out: the robot comes to rest inside of it, not on its edge
MET_N = 30.0  # a foot that carries so much in the second half of its way stands
LEAST_HEIGHT_M = 0.1  # of the pendulum


class RecoveryStep:
    """Decides on the step, and where the foot is to be until it stands again; takes no second one.

    ``usable`` is the share of the sole's length and width in which the pressure is wished: beyond that part of both
    soles it steps. Forces of the feet err by ``force_noise_n`` [N] each. The ground is taken to be level where the
    other foot stands: it knows neither edges nor stairs.

    Attributes
    ----------
    side : the foot in the air, 0 left, 1 right, None if both stand.
    began_s : when it left, since touchdown; None before the step.
    """

    def __init__(self, robot: Robot, usable: tuple[float, float], force_noise_n: float = 0.0):
        foot, self._met_n = robot.foot, max(MET_N, SURE * force_noise_n)
        self.side: int | None = None
        self.began_s: float | None = None
        self._half = np.array([(foot.toe - foot.heel) / 2, foot.half_width]) * usable
        self._beyond_since: float | None = None
        self._goal = np.zeros(3)

    def look(self, time: float, body: BodyTerms, foot_force: np.ndarray) -> None:
        """Begin, aim or end the step: ``time`` since touchdown, state in ``body``, vertical forces (2,) of the feet."""
        if self.began_s is None and self._needed(time, body, foot_force):
            self.began_s = time
            self.side = int(np.argmin([self._foothold(body, side, SWING_S)[1] for side in (0, 1)]))
        if self.side is None:
            return
        gone = time - self.began_s
        if gone > SWING_S or (gone > SWING_S / 2 and foot_force[self.side] > self._met_n):
            self.side = None
        elif gone < SWING_S - LEAST_S:
            self._goal = self._foothold(body, self.side, SWING_S - gone)[0]

    def _needed(self, time: float, body: BodyTerms, foot_force: np.ndarray) -> bool:
        beyond = False
        if time > SETTLED_S and (foot_force > 0).any():
            corners = [self._corner(body, side, x, y) for side in (0, 1) for x in (-1, 1) for y in (-1, 1)]
            beyond = beyond_hull(_capture_point(body), np.array(corners)) > BEYOND_M
        if not beyond:
            self._beyond_since = None
            return False
        self._beyond_since = time if self._beyond_since is None else self._beyond_since
        return time - self._beyond_since >= BEYOND_S

    def _corner(self, body: BodyTerms, side: int, x: float, y: float) -> np.ndarray:
        return (body.soles[side] + body.attitudes[side] @ [x * self._half[0], y * self._half[1], 0.0])[:2]

    def _foothold(self, body: BodyTerms, side: int, left_s: float) -> tuple[np.ndarray, float]:
        """Place (3,) of the sole of ``side`` that catches the robot in ``left_s``, and how far it stays off it [m]."""
        axes, off, pressure = self._over(body, 1 - side)
        want = pressure + (off - pressure) * np.exp(left_s / _pendulum_s(body, 1 - side))
        want[1] += BESIDE_M if side == 0 else -BESIDE_M
        aside = ASIDE_M if side == 0 else (-ASIDE_M[1], -ASIDE_M[0])
        there = np.array([np.clip(want[0], *FORWARD_M), np.clip(want[1], *aside)])
        stance = body.soles[1 - side]
        goal = np.append(stance[:2] + axes.T @ there, stance[2])
        return goal, float(np.linalg.norm(np.maximum(np.abs(want - there) - self._half, 0.0)))

    def _over(self, body: BodyTerms, stance: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Axes (2, 2) of the standing foot, forward and left; the capture point from it (2,) along them, and where the
        foot's pressure keeps that best.
        """
        heading = body.attitudes[stance][:2, 0] / np.linalg.norm(body.attitudes[stance][:2, 0])
        axes = np.array([heading, [-heading[1], heading[0]]])
        off = axes @ (_capture_point(body) - body.soles[stance][:2])
        return axes, off, np.clip(off, -self._half, self._half)

    def com_acceleration(self, body: BodyTerms) -> np.ndarray:
        """Level acceleration (2,) of the CoM over the standing foot [m/s^2], where it falls least.

        Less cannot be had: whoever asks for it takes the load off the foot.
        """
        stance = 1 - self.side
        axes, _, pressure = self._over(body, stance)
        return (body.com[:2] - body.soles[stance][:2] - axes.T @ pressure) / _pendulum_s(body, stance) ** 2

    def foot_acceleration(self, time: float, body: BodyTerms) -> np.ndarray:
        """Acceleration (3,) of the foot in the air [m/s^2], along cubics, over a height, to the foothold."""
        place, speed = body.soles[self.side], body.twists[self.side][:3]
        gone = time - self.began_s
        left, half = max(SWING_S - gone, LEAST_S), SWING_S / 2 - gone
        wish = 6 * (self._goal - place) / left**2 - 4 * speed / left
        if half > LEAST_S / 2:
            wish[2] = 6 * (self._goal[2] + LIFT_M - place[2]) / half**2 - 4 * speed[2] / half
        else:
            wish[2] += 2 * SINK / left
        return wish


def _capture_point(body: BodyTerms) -> np.ndarray:
    """Where the robot would come to rest (2,), seen from above [m]."""
    return body.com[:2] + body.com_velocity[:2] * _pendulum_s(body, int(np.argmin(body.soles[:, 2])))


def _pendulum_s(body: BodyTerms, stance: int) -> float:
    """sqrt(z / g) of the CoM over a foot [s]."""
    return float(np.sqrt(max(body.com[2] - body.soles[stance, 2], LEAST_HEIGHT_M) / -body.gravity[2]))


def beyond_hull(point: np.ndarray, corners: np.ndarray) -> float:
    """Signed distance of ``point`` (2,) from the convex hull of ``corners`` (k, 2) [m], positive outside.

    Of a point outside the largest distance from a side's line is told, which beside a corner is a little less.
    """
    hull = corners[ConvexHull(corners).vertices]  # counter-clockwise
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.stack([edge[:, 1], -edge[:, 0]], -1) / np.linalg.norm(edge, axis=1)[:, None]
    return float(np.max(np.sum((point - hull) * normal, axis=1)))
