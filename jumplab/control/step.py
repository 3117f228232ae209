"""Recovery steps: a foot is put to where the robot would come to rest, once that lies beyond
both soles.

On soles that stand, a pendulum of the CoM's height z comes to rest over the capture point x + v
sqrt(z / g). Pressure cannot leave the soles, and so a capture point beyond them runs away, e-fold
in each sqrt(z / g): only a foot elsewhere ends it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from jumplab.control.body import WholeBody
from jumplab.control.estimator import SURE
from jumplab.robot import Robot
from jumplab.robot.legs import size

SETTLED_S = 0.15  # after a foot came down; before, soles turn flat and the impact is not over
# the capture point this far beyond the soles, for so long
BEYOND_M = 0.01
BEYOND_S = 0.02
# the foot's way; shorter asks for more than the hip has, longer lets the robot fall further
SWING_S = 0.24
LIFT_M = 0.05  # of the sole, halfway
LEAST_S = 0.05  # a foot nearer to its end is not aimed any more
SINK = 0.3  # [m/s] at the end of its way, so that it meets ground that is lower too
# where the foot can go, from the middle of the other one
FORWARD_M = (-0.45, 0.50)
ASIDE_M = (0.15, 0.55)
BESIDE_M = 0.03  # so much further out: the robot comes to rest inside of it, not on its edge
MET_N = 30.0  # a foot that carries so much in the second half of its way stands
LEAST_HEIGHT_M = 0.1  # of the pendulum


class RecoveryStep:
    """Decides on each step, and where the foot is to be until it stands again.

    ``usable`` is the share of the sole's length and width in which the pressure is wished: beyond
    that part of both soles it steps. Forces of the feet err by ``force_noise_n`` [N] each. The
    ground is taken to be level where the other foot stands: it knows neither edges nor stairs.

    Attributes
    ----------
    side : the foot in the air, 0 left, 1 right, None if both stand.
    starts_s : when feet left, since touchdown, one time per step.
    """

    def __init__(self, robot: Robot, usable: tuple[float, float], force_noise_n: float = 0.0):
        foot = robot.foot
        large = size(robot)
        self._met_n = max(large.of(MET_N, "N"), SURE * force_noise_n)
        self._reach_m = np.transpose([large.of(np.array(x), "m") for x in (FORWARD_M, ASIDE_M)])
        self._swing_s = large.of(SWING_S, "s")
        self._least_s = large.of(LEAST_S, "s")
        self.side: int | None = None
        self.starts_s: list[float] = []
        self._half = np.array([(foot.toe - foot.heel) / 2, foot.half_width]) * usable
        self._corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * self._half
        self._beyond_since = np.inf
        self._settled_s = large.of(SETTLED_S, "s")
        self._from_s = self._settled_s
        self.goal = np.zeros(3)

    def look(self, time: float, body: WholeBody, foot_force: np.ndarray) -> None:
        """Begin, aim or end the step: ``time`` since touchdown, state in ``body``, vertical forces
        (2,) of the feet.
        """
        if self.side is None and self._needed(time, body, foot_force):
            self.starts_s.append(time)
            self._beyond_since = np.inf
            missed = [self._foothold(body, side, self._swing_s)[1] for side in (0, 1)]
            self.side = int(np.argmin(missed))
        if self.side is None:
            return
        gone = time - self.starts_s[-1]
        met = gone > self._swing_s / 2 and foot_force[self.side] > self._met_n
        if met or gone > self._swing_s:
            self.side = None
            self._from_s = time + self._settled_s
        elif gone < self._swing_s - self._least_s:
            self.goal = self._foothold(body, self.side, self._swing_s - gone)[0]

    def _needed(self, time: float, body: WholeBody, foot_force: np.ndarray) -> bool:
        beyond = False
        if time > self._from_s and (foot_force > 0).any():
            turned = self._corners @ body.attitudes[:, :2, :2].transpose(0, 2, 1)
            corners = (body.soles[:, None, :2] + turned).reshape(-1, 2)
            beyond = beyond_hull(_capture_point(body), corners) > body.size.of(BEYOND_M, "m")
        self._beyond_since = min(self._beyond_since, time) if beyond else np.inf
        return time - self._beyond_since >= body.size.of(BEYOND_S, "s")

    def _foothold(self, body: WholeBody, side: int, left_s: float) -> tuple[np.ndarray, float]:
        """Place (3,) of the sole of ``side`` that catches the robot in ``left_s``, and how far it
        stays off it [m].
        """
        axes, capture, pressure = self._over(body, 1 - side)
        out = np.array([1.0, 1.0 if side == 0 else -1.0])  # the foot's own side
        want = pressure + (capture - pressure) * np.exp(left_s / _pendulum_s(body, 1 - side))
        want = out * want + [0.0, body.size.of(BESIDE_M, "m")]
        there = np.clip(want, *self._reach_m)
        stance = body.soles[1 - side]
        goal = np.append(stance[:2] + axes.T @ (out * there), stance[2])
        return goal, float(np.linalg.norm(np.maximum(np.abs(want - there) - self._half, 0.0)))

    def _over(self, body: WholeBody, stance: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Axes (2, 2) of the standing foot, forward and left; the capture point from it (2,) along
        them, and where the foot's pressure keeps that best.
        """
        ahead = body.attitudes[stance, :2, 0]
        c, s = ahead / np.linalg.norm(ahead)
        axes = np.array([[c, s], [-s, c]])
        capture = axes @ (_capture_point(body) - body.soles[stance][:2])
        return axes, capture, np.clip(capture, -self._half, self._half)

    def com_acceleration(self, body: WholeBody) -> np.ndarray:
        """Level acceleration (2,) of the CoM over the standing foot [m/s^2], where it falls least.

        Less cannot be had: whoever asks for it takes the load off the foot.
        """
        stance = 1 - self.side
        axes, _, pressure = self._over(body, stance)
        arm = body.com[:2] - body.soles[stance][:2] - axes.T @ pressure
        return arm / _pendulum_s(body, stance) ** 2

    def foot_acceleration(self, time: float, body: WholeBody) -> np.ndarray:
        """Acceleration (3,) of the foot in the air [m/s^2], along cubics, over a height, to the
        foothold; ``time`` since touchdown [s].
        """
        place = body.soles[self.side]
        speed = body.twists[self.side][:3]
        gone = time - self.starts_s[-1]
        left = max(self._swing_s - gone, self._least_s)
        half = self._swing_s / 2 - gone
        wish = 6 * (self.goal - place) / left**2 - 4 * speed / left
        if half > self._least_s / 2:
            top = self.goal[2] + body.size.of(LIFT_M, "m")
            wish[2] = 6 * (top - place[2]) / half**2 - 4 * speed[2] / half
        else:
            wish[2] += 2 * body.size.of(SINK, "m/s") / left
        return wish


def _capture_point(body: WholeBody) -> np.ndarray:
    """Point where the robot would come to rest (2,), seen from above [m]."""
    lowest = int(np.argmin(body.soles[:, 2]))
    return body.com[:2] + body.com_velocity[:2] * _pendulum_s(body, lowest)


def _pendulum_s(body: WholeBody, stance: int) -> float:
    """sqrt(z / g) of the CoM over a foot [s]."""
    height = max(body.com[2] - body.soles[stance, 2], body.size.of(LEAST_HEIGHT_M, "m"))
    return float(np.sqrt(height / -body.gravity[2]))


def beyond_hull(point: np.ndarray, corners: np.ndarray) -> float:
    """Signed distance of ``point`` (2,) from the convex hull of ``corners`` (k, 2) [m], positive
    outside.

    Of a point outside the largest distance from a side's line is told, which beside a corner is a
    little less.
    """
    return float(np.max(ConvexHull(corners).equations @ np.append(point, 1.0)))
