"""Which links come too close in a motion, when, and which face of one keeps the other away there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from jumplab.ocp.solution import PhaseSolution
from jumplab.stages.whole_body.shapes import Pair, faces, gaps
from jumplab.stages.whole_body.terms import Body

SAMPLES = 3  # in every interval, that are looked at
NODES = 2  # before and after such an instant that a row is for
MORE_M = 0.006  # that links which met between the nodes of their row keep besides
LEAST_M = 0.002  # distance that links must keep; the audit asks for half of it


@dataclass(frozen=True)
class Apart:
    """Two links that a face keeps apart, at nodes ``first`` to ``last`` of one phase, by ``more_m`` than usual."""

    phase: int
    first: int
    last: int
    pair: Pair
    more_m: float = 0.0


def too_close(body: Body, phases: Sequence[PhaseSolution]) -> list[Apart]:
    """Rows for the links that meet in the motion of some phases, one after the other; none if all is well."""
    at = [np.linspace(0.0, p.duration, SAMPLES * (len(p.t) - 1) + 1) for p in phases]
    charts = np.concatenate([p.sample(t)[0][:, : body.model.model.nv] for p, t in zip(phases, at, strict=True)])
    configurations = body.model.to_pinocchio(charts, 0 * charts, 0 * charts)[0]
    phase = np.repeat(np.arange(len(phases)), [len(t) for t in at])
    node = np.concatenate([np.arange(len(t)) / SAMPLES for t in at])
    tree = body.model.model
    data, turns, places = tree.createData(), [], []
    for q in configurations:
        pin.forwardKinematics(tree, data, q)
        turns.append([data.oMi[j].rotation @ b.own for j, b in enumerate(body.model.bodies, start=1)])
        places.append([data.oMi[j].translation.copy() for j in range(1, tree.njoints)])
    turns, places = np.array(turns), np.array(places)
    out: list[Apart] = []
    for i, k in body.candidates:
        middle = [places[:, x.body] + turns[:, x.body] @ x.centre for x in (body.shapes[i], body.shapes[k])]
        reach = sum(np.linalg.norm(x.half) for x in (body.shapes[i], body.shapes[k]))
        if np.linalg.norm(middle[0] - middle[1], axis=1).min() > reach + LEAST_M:
            continue
        ways = [*faces(body.shapes[i], body.shapes[k]), *faces(body.shapes[k], body.shapes[i])]
        apart = np.array([gaps(way, turns, places) for way in ways])  # (12, n)
        near = np.flatnonzero(apart.max(axis=0) < LEAST_M)
        met = [row for row in near if _distance(body, i, k, configurations[row]) < LEAST_M]
        for rows in _runs(np.array(met, int)):
            best = ways[int(np.argmax(apart[:, rows].min(axis=1)))]  # one face, or neighbouring phases ask for two
            for number in np.unique(phase[rows]):
                own = rows[phase[rows] == number]
                first, last = int(node[own].min()) - NODES, int(np.ceil(node[own].max())) + NODES
                first, last = max(1, first), min(len(phases[number].t) - 1, last)
                if first <= last:
                    out.append(Apart(int(number), first, last, best))
    return out


def _runs(rows: np.ndarray) -> list[np.ndarray]:
    """Rows that follow each other with gaps of some nodes at most."""
    return [x for x in np.split(rows, np.flatnonzero(np.diff(rows) > 2 * NODES * SAMPLES) + 1) if len(x)]


def merged(old: Sequence[Apart], new: Sequence[Apart]) -> tuple[Apart, ...]:
    """Both; rows of one pair, face and phase are one row for the nodes from the first to the last of them.

    Links that met in spite of their row met between its nodes: it asks for more.
    """
    found = {(x.phase, x.pair.key): x for x in old}
    for x in new:
        key = x.phase, x.pair.key
        if key in found:
            y = found[key]
            x = Apart(x.phase, min(x.first, y.first), max(x.last, y.last), x.pair, y.more_m + MORE_M)
        found[key] = x
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
