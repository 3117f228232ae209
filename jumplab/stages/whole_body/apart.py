"""Which links come too close in a motion, when, and which face of one keeps the other away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from jumplab.io.tape import Tape
from jumplab.ocp.solution import PhaseSolution
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.motions import configurations
from jumplab.stages.whole_body.shapes import Apart, Box, Pair

SAMPLES = 3  # in every interval, that are looked at
NODES = 2  # before and after such an instant that a row is for
MORE_M = 0.006  # that links which met between the nodes of their row keep besides
MET_M = 1e-3  # nearer than what a row asks for by this, links are said to meet
TOUCH_M = 1e-3  # nearer than this they touch, for the audit
EVERY = 4  # of so many samples of a tape one is looked at

Placed = tuple[Box, np.ndarray, np.ndarray]  # middles (n, 3) and axes (n, 3, 3) of a box


def too_close(body: Body, phases: Sequence[PhaseSolution], kept_m: float) -> list[Apart]:
    """Rows for the links that are nearer than ``kept_m``, less :data:`MET_M` [m], in the motion of
    some phases, one after the other; none if all is well.
    """
    least_m = kept_m - MET_M
    at = [np.linspace(0.0, p.duration, SAMPLES * (len(p.t) - 1) + 1) for p in phases]
    phase = np.repeat(np.arange(len(phases)), [len(t) for t in at])
    node = np.concatenate([np.arange(len(t)) / SAMPLES for t in at])
    last = [len(p.t) - 1 for p in phases]
    pairs = zip(phases, at, strict=True)
    charts = np.concatenate([p.sample(t)[0][:, : body.robot.model.nv] for p, t in pairs])
    motion = configurations(body.model, charts)
    boxes = placed(body, motion)
    out: list[Apart] = []
    for number, (i, k) in enumerate(body.candidates):
        one = boxes[i]
        other = boxes[k]
        reach = np.linalg.norm(one[0].half) + np.linalg.norm(other[0].half)
        if np.linalg.norm(one[1] - other[1], axis=1).min() > reach + least_m:
            continue
        gaps = np.concatenate([face_gaps(one, other), face_gaps(other, one)])  # (12, n)
        # the first node is given, so that before the second one no row keeps them apart
        near = np.flatnonzero((gaps.max(axis=0) < least_m) & ((phase > 0) | (node >= 1)))
        met = [row for row in near if _distance(body, number, motion[row]) < least_m]
        for rows in runs(np.array(met, int), 2 * NODES * SAMPLES):
            # one, or neighbouring phases ask for two
            faces = _face(gaps, rows, least_m), _face_before(gaps, rows[0], least_m)
            # the box with the face, of both boxes' 12, is the first
            pair, before = (
                Pair(one[0], other[0], k) if k < 6 else Pair(other[0], one[0], k - 6) for k in faces
            )
            for part in np.unique(phase[rows]):
                nodes = node[rows[phase[rows] == part]]
                first = max(1, int(nodes.min()) - NODES)
                end = min(last[part], int(np.ceil(nodes.max())) + NODES)
                if first <= end:
                    out.append(Apart(int(part), first, end, pair, before=before))
    return out


def _face(gaps: np.ndarray, rows: np.ndarray, least_m: float) -> int:
    """The face that keeps two boxes apart where they meet, in ``rows`` of its ``gaps`` (12, n).

    It is one that does so before and after, if there is one: a thigh that is drawn up to the trunk
    stays below it, though beside it the way out is shorter.
    """
    clear = gaps >= least_m
    free = np.flatnonzero(clear.any(axis=0))
    around = [*free[free < rows[0]][-1:], *free[free > rows[-1]][:1]]
    may = clear[:, around].all(axis=1)
    least = gaps[:, rows].min(axis=1)
    return int(np.argmax(np.where(may, least, -np.inf) if may.any() else least))


def _face_before(gaps: np.ndarray, row: int, least_m: float) -> int:
    """The face that keeps two boxes farthest apart where they are clear last before a ``row``."""
    clear = np.flatnonzero((gaps[:, :row] >= least_m).any(axis=0))
    return int(np.argmax(gaps[:, clear[-1] if len(clear) else 0]))


def used_apart(
    body: Body, rows: Sequence[Apart], phases: Sequence[PhaseSolution], tape: Tape
) -> float:
    """Largest share [1] of what links with ``rows`` may be near, that the ``tape`` of the
    ``phases`` uses; 1 where they nearly touch.

    Its joints may leave those of the phases, between the nodes of a flight.
    """
    ends = np.cumsum([0.0, *(p.duration for p in phases)])
    names = [box.name for box in body.shapes]
    numbers = {frozenset((names[i], names[k])): n for n, (i, k) in enumerate(body.candidates)}
    least = np.inf
    for x in rows:
        number = numbers[frozenset((x.pair.first.name, x.pair.second.name))]
        step = phases[x.phase].duration / (len(phases[x.phase].t) - 1)
        during = ends[x.phase] + step * np.array([x.first, x.last])
        first, last = np.searchsorted(tape.t, during)
        for q in tape.q[first:last:EVERY]:
            least = min(least, _distance(body, number, q))
    return 2 - least / TOUCH_M


def placed(body: Body, motion: np.ndarray) -> list[Placed]:
    """All boxes in the configurations of a ``motion`` (n, nq)."""
    tree = body.robot.model
    data = tree.createData()
    places = np.empty((len(motion), len(body.model.bodies), 3))
    turns = np.empty((*places.shape, 3))
    for k, q in enumerate(motion):
        pin.forwardKinematics(tree, data, q)
        places[k] = [x.translation for x in data.oMi[1:]]
        turns[k] = [x.rotation for x in data.oMi[1:]]
    turns @= np.array([x.own for x in body.model.bodies])
    return [
        (x, places[:, x.body] + turns[:, x.body] @ x.centre, turns[:, x.body] @ x.axes)
        for x in body.shapes
    ]


def face_gaps(one: Placed, other: Placed) -> np.ndarray:
    """Distances (6, n) of the other box from the planes of all faces of one, see :class:`Pair`;
    :meth:`Pair.gap` with sharp corners [m].
    """
    ways = one[2].transpose(0, 2, 1)
    ahead = (ways @ (other[1] - one[1])[..., None])[..., 0]
    room = one[0].half + np.abs(ways @ other[2]) @ other[0].half
    return np.stack([-ahead - room, ahead - room], axis=-1).reshape(len(room), 6).T


def runs(rows: np.ndarray, gap: int = 1) -> list[np.ndarray]:
    """Parts of rising numbers (n,) that follow each other with no ``gap`` wider than that."""
    return [x for x in np.split(rows, np.flatnonzero(np.diff(rows) > gap) + 1) if len(x)]


def merged(old: Sequence[Apart], new: Sequence[Apart]) -> tuple[Apart, ...]:
    """Both; rows of one pair, face and phase are one row for the nodes from the first to the last
    of them.

    Links that met where their row is met between its nodes: it asks for :data:`MORE_M` [m] more.
    """
    out = {(x.phase, x.pair.key): x for x in old}
    for x in new:
        key = x.phase, x.pair.key
        if y := out.get(key):
            more = y.more_m + MORE_M * (x.first + NODES >= y.first and x.last - NODES <= y.last)
            x = replace(x, first=min(x.first, y.first), last=max(x.last, y.last), more_m=more)
        out[key] = x
    return tuple(out.values())


def as_before(rows: Sequence[Apart]) -> tuple[Apart, ...]:
    """Rows with the faces that kept the links apart before they met; one row a face and phase."""
    out: dict[tuple, Apart] = {}
    for x in rows:
        pair = x.before or x.pair
        y = out.get((x.phase, pair.key), x)
        ends = min(x.first, y.first), max(x.last, y.last)
        out[x.phase, pair.key] = Apart(x.phase, *ends, pair, before=x.before)
    return tuple(out.values())


def _distance(body: Body, number: int, q: np.ndarray) -> float:
    """Distance of two links, by the number of their pair, in a configuration (nq,) [m]; negative if
    they meet.
    """
    tree = body.robot.model
    placed = body.geometry.createData()
    pin.updateGeometryPlacements(tree, tree.createData(), body.geometry, placed, q)
    return float(pin.computeDistance(body.geometry, placed, number).min_distance)
