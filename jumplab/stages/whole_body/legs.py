"""Legs that follow from the feet that carry: inverse kinematics on three levels, for many instants at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from jumplab.models.spatial import SpatialState

if TYPE_CHECKING:
    from jumplab.stages.whole_body.terms import WholeBodyTerms

LEG_STEPS = 3  # of Newton's method from errors below a millimetre
HELD_M = 1e-10  # [m, rad] closer, a foot is in its place

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]  # charts, rates, accelerations, each (n, 6 + joints)


class Legs:
    """Feet that carry as functions of the chart, mapped over many instants; made once for a mode."""

    def __init__(self, b: WholeBodyTerms):
        self.b, body, n = b, b.body, b.nv
        q, v, a, holds = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("a", n), ca.SX.sym("holds", 4, len(b.modes))
        state, rows, self.pitches = SpatialState(b.model, q, q, q), [], {}
        for i, side in enumerate(b.modes):
            turn = state.rotation(body.feet[side]) @ ca.DM(body.axes[side])
            place = state.point(body.feet[side], body.tips[side]) - holds[:3, i]
            short = body.short and side == 1
            rows.append(place[[0, 2]] if short else place)
            heading = ca.cos(holds[3, i]) * turn[1, 0] - ca.sin(holds[3, i]) * turn[0, 0]
            rows.append(ca.vertcat(heading, turn[2, 1], turn[2, 0]))
            self.pitches[side] = sum(x.numel() for x in rows) - 1
            if short:
                rows.append(q[[3, 4]])
        rows = ca.vertcat(*rows)
        slope = ca.jtimes(rows, q, v)
        drift = ca.jtimes(slope, ca.vertcat(q, v), ca.vertcat(v, a))
        self._levels = ca.Function("levels", [q, v, a, holds], [slope, drift])
        self.columns = np.array([1, 3, 4] * body.short + [k for side in b.modes for k in body.legs[side]])
        slopes = ca.densify(ca.jacobian(rows, q)[:, self.columns.tolist()])
        self._slope = ca.Function("slope", [q, holds], [rows, slopes])

    def held(self, motion: Motion, holds: Mapping[int, np.ndarray], pitch: Mapping[int, Motion]) -> Motion:
        """The motion with the legs moved so that the feet stay in their places.

        ``holds`` are x, y, z [m] and yaw [rad] of the middles of the toe edges, ``pitch`` angle, rate and acceleration
        (n,) of each foot on its toes, by side.
        """
        n, (q, v, a) = len(motion[0]), (x.copy() for x in motion)
        given = np.tile(np.column_stack(list(holds.values())), n)
        goals = np.zeros((3, n, self._levels.size1_out(0)))
        for side, (angle, rate, gain) in pitch.items():
            s, c, at = np.sin(angle), np.cos(angle), self.pitches[side]
            goals[0, :, at], goals[1, :, at], goals[2, :, at] = -s, -c * rate, s * rate**2 - c * gain

        def seen():
            rows, slope = (x.full() for x in self._slope.map(n)(q.T, given))
            return rows.T, slope.reshape(rows.shape[0], n, -1).transpose(1, 0, 2)

        for _ in range(LEG_STEPS):
            rows, slope = seen()
            if np.abs(goals[0] - rows).max() < HELD_M:
                break
            q[:, self.columns] += self._solved(slope, goals[0] - rows)
            slope = None
        slope = seen()[1] if slope is None else slope
        v[:, self.columns] += self._solved(slope, goals[1] - self._levels.map(n)(q.T, v.T, a.T, given)[0].full().T)
        a[:, self.columns] += self._solved(slope, goals[2] - self._levels.map(n)(q.T, v.T, a.T, given)[1].full().T)
        return q, v, a

    def _solved(self, slope: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Least changes (n, .) of the columns that make up for what rows are off by (n, .)."""
        across = slope.transpose(0, 2, 1)
        return (across @ np.linalg.solve(slope @ across, off[..., None]))[..., 0]
