"""Where the spatial program starts: stage 2's motion, or a planar plan of the same rise with ramps of side and yaw."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.models.spatial import spin_slope
from jumplab.ocp.solution import PhaseGuess
from jumplab.stages.spatial.terms import MOMENT_ARM_M, PYRAMID, SpatialTerms
from jumplab.stages.whole_body.settings import Contact, Mesh
from jumplab.task import JumpTask

SMOOTHING_S = 0.05  # about a node's distance


def from_tape(
    terms: dict[str, SpatialTerms], tape: Tape, toe_phase_s: float, mesh: Mesh, task: JumpTask, ramps: bool = True
) -> dict:
    """Phase name -> :class:`PhaseGuess` from a ``tape`` whose heels rise at ``toe_phase_s``.

    With ``ramps`` the tape is one straight ahead, and side and yaw are added in flight.
    """
    from scipy.ndimage import gaussian_filter1d  # as all of scipy here, slow to import, and not for jumps in the plane

    split, end = tape.takeoff_time, float(tape.t[-1])
    row, out = tape.takeoff_index, {}
    for name, t in mesh.nodes(toe_phase_s, split, end).items():
        part = slice(row, None) if name == "flight" else slice(0, row)
        b = terms[name]
        q, v, a, tau, f = (_sampled(t, tape.t[part], x[part]) for x in (tape.q, tape.v, tape.a, tape.tau, tape.f))
        q, v, a = _charts(b, q, v, a)
        if not ramps:  # a roll-out, which rings where a node may fall anywhere
            h = (t[-1] - t[0]) / (len(t) - 1)
            v = gaussian_filter1d(v, SMOOTHING_S / h, axis=0, mode="nearest")
            a = np.gradient(v, h, axis=0)
        if b.contact is Contact.FLIGHT:
            s = np.linspace(0, 1, len(t))
            flight_s = end - split
            com, speed = _takeoff(b, tape, row)
            if ramps:
                q[:, 3], v[:, 3] = task.yaw_rad * s, task.yaw_rad / flight_s
                speed[1] = task.side_m / flight_s
            constants = {
                f"{k}_{x}": y for k, col in (("com", com), ("vel", speed)) for x, y in zip("xyz", col, strict=True)
            }
            if task.rotation_rad:
                constants |= {f"L_{x}": y for x, y in zip("xyz", _spin(b, tape, row), strict=True)}
            z = np.hstack([np.zeros((len(t), 3)), tau])
            out[name] = PhaseGuess(flight_s, q[:, 3:], v[:, 3:], a[:, 3:], z, constants)
        else:
            z = np.hstack([spread(b, q, f), tau])
            out[name] = PhaseGuess(t[-1] - t[0], q, v, a, z)
    return out


def _sampled(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    return np.stack([np.interp(t, times, x) for x in flat.T], -1).reshape(len(t), *values.shape[1:])


def _charts(b: SpatialTerms, q, v, a):
    """Charts of a motion, their rates and accelerations; the inverse of :meth:`SpatialModel.to_pinocchio`."""
    chart = b.model.of_pinocchio(q)
    turn, slope = b.model.rotations(chart), spin_slope(chart[:, 4], chart[:, 5])
    rates = np.linalg.solve(slope, v[:, 3:6, None])[..., 0]
    drift = b.model.to_pinocchio(chart, np.concatenate([0 * q[:, :3], rates, 0 * q[:, 7:]], 1), 0 * v)[2][:, 3:6]

    def charted(linear, angles, joints):
        return np.concatenate([np.einsum("nij,nj->ni", turn, linear), angles, joints[:, 6:]], axis=1)

    turning = a[:, :3] + np.cross(v[:, 3:6], v[:, :3])
    speeds = np.linalg.solve(slope, (a[:, 3:6] - drift)[..., None])[..., 0]
    return chart, charted(v[:, :3], rates, v), charted(turning, speeds, a)


def _takeoff(b: SpatialTerms, tape: Tape, row: int) -> tuple[np.ndarray, np.ndarray]:
    model, data = b.model.model, b.model.model.createData()
    pin.centerOfMass(model, data, tape.q[row], tape.v[row])
    return data.com[0].copy(), data.vcom[0].copy()


def _spin(b: SpatialTerms, tape: Tape, row: int) -> np.ndarray:
    model, data = b.model.model, b.model.model.createData()
    return pin.computeCentroidalMomentum(model, data, tape.q[row], tape.v[row]).angular.copy()


def generators(b: SpatialTerms, side: int) -> np.ndarray:
    """(6, 4 k): force and moment about the world's origin per unit of each cone edge of one foot."""
    mu, columns = b.limits.friction, []
    for corner in b.corners[side]:
        for x, y in mu * PYRAMID:
            force = np.array([x, y, 1.0])
            columns.append(np.concatenate([force, np.cross(corner, force)]))
    return np.array(columns).T


def spread(b: SpatialTerms, q: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Forces along the cones' edges (n, 2 * 4 k) that come nearest to wrenches (n, 2, 6) at the feet's frames."""
    from scipy.optimize import nnls

    model, data = b.model.model, b.model.model.createData()
    frames = [model.getFrameId(name) for name in b.robot.foot.frames]
    edges, weight, out = [generators(b, side) for side in (0, 1)], np.repeat([1.0, 1 / MOMENT_ARM_M], 3), []
    still = np.zeros_like(q)
    for config, wrench in zip(b.model.to_pinocchio(q, still, still)[0], f, strict=True):
        pin.framesForwardKinematics(model, data, config)
        found = []
        for one, w, frame in zip(edges, wrench, frames, strict=True):
            about = np.concatenate([w[:3], w[3:] + np.cross(data.oMf[frame].translation, w[:3])])
            small = 1e-2 * np.eye(one.shape[1])  # spreads what several sets of forces could do
            rows = np.vstack([weight[:, None] * one, small])
            found.append(nnls(rows, np.concatenate([weight * about, np.zeros(one.shape[1])]))[0])
        out.append(np.concatenate(found))
    return np.array(out)
