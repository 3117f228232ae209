"""Legs that follow from the feet that carry: inverse kinematics on three levels, for many instants
at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from jumplab.models.spatial import SpatialState
from jumplab.stages.whole_body.body import Body

LEG_STEPS = 3  # of Newton's method from errors below a millimetre
HELD_M = 1e-10  # [m, rad] closer, a foot is in its place


def off_foothold(tree: SpatialState, body: Body, side: int, place: ca.SX, yaw: ca.SX) -> ca.SX:
    """Deviation of a foot from its foothold (6,): the middle of its toe edge from a ``place`` (3,)
    [m], heading from ``yaw`` [rad], roll, and minus the sine of its pitch.
    """
    foot = body.feet[side]
    turn = tree.rotation(foot) @ ca.DM(body.axes[side])
    heading = ca.cos(yaw) * turn[1, 0] - ca.sin(yaw) * turn[0, 0]
    return ca.vertcat(tree.point(foot, body.tips[side]) - place, heading, turn[2, 1], turn[2, 0])


def independent(rows: ca.SX, short: bool, side: int, yaw_and_roll: ca.SX) -> ca.SX:
    """Of the six rows of a foot (x, y, z, heading, roll, pitch) those that can hold: short legs
    leave the base no ``yaw_and_roll`` (2,), and the right foot's side follows.
    """
    if not short or side == 0:
        return rows
    return ca.vertcat(rows[[0, 2, 3, 4, 5]], yaw_and_roll)


class Legs:
    """Feet of some ``sides`` as functions of the chart, mapped over many instants."""

    def __init__(self, body: Body, sides: Sequence[int]):
        self.body = body
        q, v, a = (ca.SX.sym(name, len(body.stance)) for name in "qva")
        holds = ca.SX.sym("holds", 4, len(sides))
        tree = SpatialState(body.model, q, q, q)
        rows = ca.SX(0, 1)
        self.pitches = {}  # side -> row of its pitch
        for side, hold in zip(sides, ca.horzsplit(holds), strict=True):
            self.pitches[side] = rows.numel() + (4 if body.short and side else 5)
            six = off_foothold(tree, body, side, hold[:3], hold[3])
            rows = ca.vertcat(rows, independent(six, body.short, side, q[3:5]))
        self.columns = [1, 3, 4] * body.short + [k for side in sides for k in body.legs[side]]
        slope = ca.densify(ca.jacobian(rows, q)[:, self.columns])
        rates = ca.jtimes(rows, q, v)
        drift = ca.jtimes(rates, ca.vertcat(q, v), ca.vertcat(v, a))
        self._place = ca.Function("place", [q, holds], [rows, slope])
        self._levels = ca.Function("levels", [q, v, a, holds], [rates, drift])

    @staticmethod
    def of(body: Body, sides: Sequence[int]) -> Legs:
        """Those of a robot, made once."""
        key = tuple(sides)
        if key not in body.made:
            body.made[key] = Legs(body, key)
        return body.made[key]

    def held(
        self, motion: np.ndarray, holds: Mapping[int, np.ndarray], raised: Sequence[int]
    ) -> np.ndarray:
        """Charts, rates and accelerations (3, n, 6 + joints) of a ``motion`` with the legs moved so
        that the feet stay in their places.

        Behind its charts a motion has the pitch of the feet that are ``raised`` on their toes;
        ``holds`` are x, y, z [m] and yaw [rad] of the middles of the toe edges, by side.
        """
        size = len(self.body.stance)
        q, v, a = held = motion[..., :size].copy()
        angle, rate, gain = motion[..., size:]
        n = len(q)
        given = np.tile(np.column_stack(list(holds.values())), n)
        goals = np.zeros((3, n, self._place.size1_out(0)))
        s = np.sin(angle)
        c = np.cos(angle)
        pitches = [self.pitches[side] for side in raised]
        goals[..., pitches] = -s, -c * rate, s * rate**2 - c * gain
        for left in range(LEG_STEPS, -1, -1):
            rows, slope = (x.full() for x in self._place.map(n)(q.T, given))
            slope = slope.reshape(len(rows), n, -1).transpose(1, 0, 2)
            missed = goals[0] - rows.T
            if not left or np.abs(missed).max() < HELD_M:
                break
            q[:, self.columns] += _least(slope, missed)
        for level, x in enumerate((v, a)):
            reached = self._levels.map(n)(q.T, v.T, a.T, given)[level].full().T
            x[:, self.columns] += _least(slope, goals[1 + level] - reached)
        return held


def _least(slope: np.ndarray, missed: np.ndarray) -> np.ndarray:
    """Least changes (n, .) of the columns that make up for what is missed (n, k)."""
    across = slope.transpose(0, 2, 1)
    return np.matvec(across, np.linalg.solve(slope @ across, missed[..., None])[..., 0])
