"""Which links come too close on a tape, when, and which face of one keeps the other away there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.stages.spatial.shapes import Pair, faces, gaps
from jumplab.stages.spatial.terms import Body

STEP_S = 0.008  # between the instants that are looked at
NODES = 2  # before and after such an instant that a row is for
LEAST_M = 0.002  # distance that links must keep; the audit asks for half of it


@dataclass(frozen=True)
class Apart:
    """Two links that a face keeps apart, at nodes ``first`` to ``last`` of one phase."""

    phase: int
    first: int
    last: int
    pair: Pair


def too_close(body: Body, tape: Tape, durations: Sequence[float], intervals: Sequence[int]) -> list[Apart]:
    """Rows for the links that meet on a tape of phases with these durations [s] and intervals; none if all is well."""
    at = np.unique(np.searchsorted(tape.t, np.arange(0.0, tape.t[-1], STEP_S)))
    tree = body.model.model
    data, turns, places = tree.createData(), [], []
    for q in tape.q[at]:
        pin.forwardKinematics(tree, data, q)
        turns.append([data.oMi[j].rotation @ b.own for j, b in enumerate(body.model.bodies, start=1)])
        places.append([data.oMi[j].translation.copy() for j in range(1, tree.njoints)])
    turns, places = np.array(turns), np.array(places)
    out: list[Apart] = []
    for i, k in body.candidates:
        ways = [*faces(body.shapes[i], body.shapes[k]), *faces(body.shapes[k], body.shapes[i])]
        apart = np.array([gaps(way, turns, places) for way in ways])  # (12, n)
        near = np.flatnonzero(apart.max(axis=0) < LEAST_M)
        met = [row for row in near if _distance(body, i, k, tape.q[at[row]]) < LEAST_M]
        if met:
            out += _rows(ways, apart, met, tape.t[at], durations, intervals)
    return out


def merged(old: Sequence[Apart], new: Sequence[Apart]) -> tuple[Apart, ...]:
    """Both; rows of one pair, face and phase are one row for the nodes from the first to the last of them."""
    found: dict[tuple, Apart] = {}
    for x in (*old, *new):
        key = x.phase, x.pair.key
        y = found.get(key, x)
        found[key] = Apart(x.phase, min(x.first, y.first), max(x.last, y.last), x.pair)
    return tuple(found.values())


def _distance(body: Body, i: int, k: int, q: np.ndarray) -> float:
    """Distance of two links in a configuration (nq,) [m]; negative if they meet."""
    tree, geometry = body.model.model, body.geometry
    data = tree.createData()
    pin.forwardKinematics(tree, data, q)
    shapes = [geometry.geometryObjects[n] for n in (i, k)]
    moved = [data.oMi[s.parentJoint] * s.placement for s in shapes]
    poses = [coal.Transform3s(m.rotation, m.translation) for m in moved]
    found = coal.DistanceResult()
    coal.distance(shapes[0].geometry, poses[0], shapes[1].geometry, poses[1], coal.DistanceRequest(), found)
    return float(found.min_distance)


def _rows(ways, apart, met: list[int], t: np.ndarray, durations, intervals) -> list[Apart]:
    """A row for each phase in which two links meet, with the face that is violated least there."""
    ends, out = np.cumsum(durations), []
    phase = np.minimum(np.searchsorted(ends, t[met] + 1e-9), len(ends) - 1)
    for k in np.unique(phase):
        rows = np.array(met)[phase == k]
        best = ways[int(np.argmax(apart[:, rows].min(axis=1)))]
        step = durations[k] / intervals[k]
        since = (t[rows] - (ends[k] - durations[k])) / step
        first, last = max(1, int(since.min()) - NODES), min(intervals[k], int(since.max()) + 1 + NODES)
        if first <= last:
            out.append(Apart(int(k), first, last, best))
    return out
