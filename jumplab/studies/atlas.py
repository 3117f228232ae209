"""A memory of motion: direct plans over a grid of distance and height, from which any target between them is a few
steps away.

Rows of equal height are solved side by side; within a row each node begins with its neighbour's solution. Several
local solutions may lie side by side; sweeps over the finished grid then offer every node its neighbours' motions, and
the cheapest stays. A target is answered by the four nodes around it, interpolated; where they do not fit together, by
the nearest one.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from jumplab.auditing.audit import audit
from jumplab.errors import InfeasibleError, InputError, JumplabError, SolverError, require_type
from jumplab.io.files import locked, made, write_file
from jumplab.ocp.assembly import pack, unpack
from jumplab.ocp.cache import fingerprint
from jumplab.ocp.derivatives import ElementBuilder
from jumplab.ocp.problem import layouts
from jumplab.robot import Robot
from jumplab.stages.planner import Planner, here, make_tape
from jumplab.stages.whole_body import WholeBodyPlan, WholeBodyPlanner
from jumplab.studies.envelope import most_used
from jumplab.task import JumpTask

FILE, FORMAT = "atlas.npz", 2
MAX_NODES = 2500  # some minutes of work, ten seconds to load
GIVE_UP = 2  # so many nodes in a row without a plan, and the farther ones of the row are not tried
SWEEPS = 3  # over the grid; the last one seldom finds anything
CHEAPER = 0.99  # a neighbour's motion replaces a node's own if it costs less than this share
MIXED = 1.01  # four nodes whose blend costs this much more than they do on average are of different kinds


@dataclass(frozen=True)
class Node:
    """One plan of an atlas, as the start of others."""

    distance_m: float
    height_m: float
    cost: float
    limiting: str  # what is used most
    share: float  # of its limit
    x: np.ndarray  # (n,) the motion, as the problem's scaled variables


class Atlas:
    """Plans over a grid; give it to :class:`jumplab.Planner`, whose direct plans then begin with it.

    Attributes
    ----------
    distances, heights : the grid's values [m], rising.
    nodes : (distance, height) -> :class:`Node`, of those that have a plan.
    key : what the plans were made of: robot, terms, weights, limits, mesh.
    """

    def __init__(self, robot: str, distances: Sequence[float], heights: Sequence[float], nodes: Mapping, key: str):
        self.robot, self.key, self.nodes = robot, key, dict(nodes)
        self.distances, self.heights = tuple(map(float, distances)), tuple(map(float, heights))

    def __repr__(self) -> str:
        count = len(self.distances) * len(self.heights)
        return (
            f"Atlas({self.robot}, {self.distances[0]:g} ... {self.distances[-1]:g} m far, {self.heights[0]:g} ... "
            f"{self.heights[-1]:g} m high, {len(self.nodes)} of {count} planned)"
        )

    # building -----------------------------------------------------------------------------------------------------
    @classmethod
    def build(
        cls,
        robot: Robot,
        distances: Sequence[float],
        heights: Sequence[float],
        *,
        folder: str | Path | None = None,
        jobs: int = 1,
        tell: Callable[[str], None] | None = None,
        **how: Any,
    ) -> Atlas:
        """Plan the grid of ``distances`` and ``heights`` [m].

        Parameters
        ----------
        folder : where ``atlas.npz`` is written, row by row; an unfinished one is gone on with, and a finished one read.
        jobs : processes that share the rows.
        tell : called with a line per finished row.
        how : further arguments of :class:`jumplab.Planner`: terms, weights, off, limits, mesh, keep (True).

        Raises
        ------
        InputError
            If the grid is empty, not rising or too large, or ``folder`` holds an atlas of something else.
        """
        require_type(robot, Robot, "the robot of the atlas")
        distances, heights = _axis("distances", distances), _axis("heights", heights)
        if len(distances) * len(heights) > MAX_NODES:
            raise InputError(f"the atlas has {len(distances)} x {len(heights)} nodes, at most {MAX_NODES}")
        for distance, height in product(distances, heights):
            JumpTask(distance, height)  # refuses what no task may ask
        planner = Planner(robot, **{"keep": True} | how)
        body, tell = planner.program(), tell or (lambda line: None)
        atlas, done = cls(robot.name, distances, heights, {}, key_of(body)), set()
        if folder is not None and (Path(folder) / FILE).exists():
            atlas, done = _read(Path(folder) / FILE, robot, atlas)
        left = [h for h in heights if h not in done]
        run = joblib.Parallel(n_jobs=jobs, return_as="generator")
        for height, row in run(joblib.delayed(_plan_row)(planner, height, distances) for height in left):
            atlas.nodes.update({(n.distance_m, n.height_m): n for n in row})
            done.add(height)
            tell(f"height {height:.2f} m: {len(row)} of {len(distances)} planned")
            if folder is not None:
                atlas.save(folder, done)
        if left:
            changed = atlas._swept(body)
            tell(f"{changed} nodes took a cheaper motion from a neighbour")
            if folder is not None:
                atlas.save(folder, done)
        return atlas

    def _swept(self, body: WholeBodyPlanner) -> int:
        """Offer every node its neighbours' motions; returns how many changed theirs."""
        changed = 0
        for _ in range(SWEEPS):
            before = changed
            for place in list(self.nodes):
                for near in self._around(place):
                    node = _cheaper(body, self.nodes[place], near)
                    if node is not None:
                        self.nodes[place], changed = node, changed + 1
            if changed == before:
                break
        return changed

    def _around(self, place: tuple[float, float]) -> list[Node]:
        i, j = self.distances.index(place[0]), self.heights.index(place[1])
        beside = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        inside = [(a, b) for a, b in beside if 0 <= a < len(self.distances) and 0 <= b < len(self.heights)]
        places = ((self.distances[a], self.heights[b]) for a, b in inside)
        return [self.nodes[p] for p in places if p in self.nodes]

    # use ----------------------------------------------------------------------------------------------------------
    def starts(self, task: JumpTask) -> list[Node]:
        """Motions to begin with: the blend of the four nodes around the target if all are there, then the nearest.

        Empty for targets outside, see :meth:`beyond`, and for platforms, flips, other gravity and jumps out of the
        plane.
        """
        plain = replace(task, distance_m=0.0, height_m=0.5) == JumpTask(0.0, 0.5)
        if not plain or self.beyond(task) is not None:
            return []
        (i, u), (j, w) = _between(self.distances, task.distance_m), _between(self.heights, task.height_m)
        shares = {
            (self.distances[i + a], self.heights[j + b]): x * y
            for (a, x), (b, y) in product(((0, 1 - u), (1, u)), ((0, 1 - w), (1, w)))
            if x * y > 0
        }
        known = {p: s for p, s in shares.items() if p in self.nodes}
        if not known:
            return []
        nearest = self.nodes[max(known, key=known.get)]
        if known != shares or len(known) == 1:
            return [nearest]
        nodes, s = [self.nodes[p] for p in known], np.array(list(known.values()))
        blend = replace(
            nearest,
            distance_m=task.distance_m,
            height_m=task.height_m,
            cost=float(s @ [n.cost for n in nodes]),
            x=s @ [n.x for n in nodes],
        )
        return [blend, nearest]

    def beyond(self, task: JumpTask) -> str | None:
        """Why a target lies outside the atlas, and what limits there; None if it lies inside."""
        for name, unit, axis, x in (
            ("distance", "m", self.distances, task.distance_m),
            ("height", "m", self.heights, task.height_m),
        ):
            if not axis[0] - 1e-9 <= x <= axis[-1] + 1e-9:
                return (
                    f"{name} = {x:g} {unit}: the atlas goes from {axis[0]:g} to {axis[-1]:g} {unit}{self._limit(task)}"
                )
        return None

    def _limit(self, task: JumpTask) -> str:
        """Words about the planned node next to a target outside."""
        if not self.nodes:
            return ""
        near = min(
            self.nodes.values(), key=lambda n: math.hypot(n.distance_m - task.distance_m, n.height_m - task.height_m)
        )
        return (
            f"; its nearest plan is {near.distance_m:g} m far and {near.height_m:g} m high, where {near.limiting} is "
            f"used by {100 * near.share:.0f} %"
        )

    def solve(self, body: WholeBodyPlanner, task: JumpTask, start: np.ndarray | None = None) -> WholeBodyPlan | None:
        """The direct plan for a target from the nodes around it; None if they lead nowhere.

        ``body`` is the planner's program of jumps straight ahead; raises :class:`InputError` if the atlas was made of
        something else.
        """
        if key_of(body) != self.key:
            raise InputError(
                f"the atlas is of robot {self.robot} with other limits, terms or mesh than this planner of "
                f"{body.robot.name}; build one for it, or leave the atlas away"
            )
        best = None
        for node in self.starts(task):
            try:
                plan = _from(body, task, node, start)
            except SolverError:
                continue
            cost = plan.solution.statistics.objective
            if best is None or cost < best.solution.statistics.objective:
                best = plan
            if cost <= MIXED * node.cost:
                break
        return best

    # file ---------------------------------------------------------------------------------------------------------
    def save(self, folder: str | Path, done: Sequence[float] | None = None) -> Path:
        """Write ``atlas.npz`` into ``folder``; ``done`` are the finished heights, all if None."""
        nodes = list(self.nodes.values())
        head = {"format": FORMAT, "robot": self.robot, "key": self.key}
        head |= {"distances": self.distances, "heights": self.heights}
        head["done"] = sorted(self.heights if done is None else done)
        head["nodes"] = [(n.distance_m, n.height_m, n.cost, n.limiting, n.share) for n in nodes]
        buffer, folder = io.BytesIO(), Path(folder)
        np.savez_compressed(buffer, head=np.array(json.dumps(head)), rows=np.array([n.x for n in nodes]))
        with made(folder), locked(folder):
            return write_file(folder / FILE, buffer.getvalue())

    @classmethod
    def load(cls, folder: str | Path) -> Atlas:
        """The atlas of a folder; raises :class:`InputError` if there is none, or it is damaged."""
        return _loaded(Path(folder) / FILE)[0]


def key_of(body: WholeBodyPlanner) -> str:
    """What plans of a direct planner are made of."""
    problem = body.nlp.problem
    values = [
        (o, t.name, t.weight, *(np.asarray(x).tolist() for x in (t.lower, t.upper) if not callable(x)))
        for o, t in problem.terms()
    ]
    intervals = sorted(body.mesh.intervals().items())
    bounds = [(owner, b.name, b.equation, b.on, b.where) for owner, b in problem.bounds()]
    parts = ElementBuilder(problem, layouts(problem)).parts
    words = [bounds, *(part.words(problem) for part in parts)]
    return fingerprint(words, f"{body.robot.hash} {body.limits} {body.weights} {values} {intervals}")


def _axis(name: str, values: Sequence[float]) -> tuple[float, ...]:
    values = tuple(round(float(x), 9) for x in values)
    if not values or list(values) != sorted(set(values)):
        raise InputError(f"the {name} of an atlas must be rising, at least one; got {len(values)} values")
    return values


def _between(axis: Sequence[float], x: float) -> tuple[int, float]:
    """The interval of ``axis`` that holds ``x``, and the share of it below."""
    if len(axis) == 1:
        return 0, 0.0
    i = min(max(int(np.searchsorted(axis, x, side="right")) - 1, 0), len(axis) - 2)
    share = (x - axis[i]) / (axis[i + 1] - axis[i])
    return i, float(np.clip(round(share, 9), 0.0, 1.0))


def _node(body: WholeBodyPlanner, plan: WholeBodyPlan) -> Node:
    most = most_used(audit(make_tape(plan), body.robot, plan.task), body.robot)
    motion = plan.solution.guess(body.mesh.intervals())  # it may have been solved on a finer mesh
    cost, x = plan.solution.statistics.objective, pack(body.nlp.assembled, motion)
    return Node(plan.task.distance_m, plan.task.height_m, cost, *most, x)


def _plan_row(planner: Planner, height: float, distances: Sequence[float]) -> tuple[float, list[Node]]:
    """Nodes of one height, from near to far, each from its neighbour's solution."""
    body, plan, row, failed = here(planner).program(), None, [], 0
    for distance in distances:
        task = JumpTask(distance, height)
        try:
            plan = body.plan(task, near=plan)
        except (SolverError, InfeasibleError):
            plan, failed = None, failed + 1
            if failed >= GIVE_UP:
                break
            continue
        failed = 0
        row.append(_node(body, plan))
    return height, row


def _cheaper(body: WholeBodyPlanner, node: Node, near: Node) -> Node | None:
    """``node`` with the motion of a neighbour, if that costs less."""
    task = JumpTask(node.distance_m, node.height_m)
    try:
        plan = _from(body, task, near)
        if plan.solution.statistics.objective >= CHEAPER * node.cost:
            return None
        found = _node(body, body.plan(task, near=plan))
        return found if found.cost < CHEAPER * node.cost else None
    except JumplabError:
        return None


def _from(body: WholeBodyPlanner, task: JumpTask, node: Node, start: np.ndarray | None = None) -> WholeBodyPlan:
    """The plan for a target a few steps from a node; raises :class:`SolverError` if it is not that close."""
    near = {name: phase.guess() for name, phase in unpack(body.nlp.assembled, node.x).items()}
    return body.beside(task, near, stance=start)


def _loaded(path: Path) -> tuple[Atlas, set[float]]:
    """The atlas on file, and its finished heights."""
    try:
        with np.load(path, allow_pickle=False) as file:
            head, rows = json.loads(str(file["head"])), file["rows"]
        if head["format"] != FORMAT or not np.all(np.isfinite(rows)):
            raise ValueError("other format, or numbers that are none")
        known = zip(head["nodes"], rows, strict=True)
        nodes = {(d, h): Node(d, h, *rest, row) for (d, h, *rest), row in known}
        return Atlas(head["robot"], head["distances"], head["heights"], nodes, head["key"]), set(head["done"])
    except FileNotFoundError:
        raise InputError(f"{str(path.parent)!r} has no {FILE}; build one with 'jumplab atlas'") from None
    except (OSError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile) as e:
        said = f"{str(path)!r} is damaged or no atlas ({type(e).__name__}); delete it and build it again"
        raise InputError(said) from None


def _read(path: Path, robot: Robot, wanted: Atlas) -> tuple[Atlas, set[float]]:
    """An atlas on file to go on with, if it is the ``wanted`` one."""
    atlas, done = _loaded(path)
    if atlas.key != wanted.key:
        said = f"{str(path)!r} is of robot {atlas.robot} with other limits, terms or mesh, not of this {robot.name}"
        raise InputError(f"{said}; choose another folder")
    if (atlas.distances, atlas.heights) != (wanted.distances, wanted.heights):
        raise InputError(f"{str(path)!r} has another grid of distances and heights; choose another folder")
    return atlas, done
