"""A memory of motion: direct plans over a grid of distance and height, from which any target
between them is a few steps away.

A target is answered by the four nodes around it, interpolated; where they do not fit together
(several local solutions may lie side by side), by the nearest one.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jumplab import reading
from jumplab.arguments import checked
from jumplab.errors import InputError, SolverError, quoted
from jumplab.io.files import locked, made, write_file
from jumplab.ocp.cache import fingerprint
from jumplab.ocp.derivatives import parts
from jumplab.ocp.nlp import unexplained
from jumplab.ocp.posing import pack, unpack
from jumplab.robot import Robot
from jumplab.stages.planner import Planner, here
from jumplab.stages.whole_body import WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.starts import FROM_NEIGHBOUR
from jumplab.studies.grid import MAX_CELLS, plan_cell, plan_rows
from jumplab.studies.study import Plain, short_hash
from jumplab.task import JumpTask

AHEAD = JumpTask(0.5, 0.3)  # whose program is that of every jump straight ahead
FILE = "atlas.npz"
FORMAT = 2
# four nodes whose blend costs this much more than they do on average are of different kinds
MIXED = 1.01


@dataclass(frozen=True)
class Node:
    """One plan of an atlas, as the start of others."""

    distance_m: float
    height_m: float
    cost: float
    x: np.ndarray  # (n,) the motion, as the problem's scaled variables


@checked
@dataclass(repr=False, eq=False)
class Atlas:
    """Plans over a grid; give it to :class:`jumplab.Planner`, whose direct plans then begin with
    it.

    Attributes
    ----------
    robot : its name.
    distances, heights : the grid's values [m], rising.
    nodes : (distance, height) -> :class:`Node`, of those that have a plan.
    key : what the plans were made of: robot, terms, weights, limits, mesh.
    """

    robot: str
    distances: tuple[float, ...]
    heights: tuple[float, ...]
    nodes: dict[tuple[float, float], Node]
    key: str

    def __repr__(self) -> str:
        count = len(self.distances) * len(self.heights)
        far, high = (f"{x[0]:g} ... {x[-1]:g} m" for x in (self.distances, self.heights))
        return f"Atlas({self.robot}, {far} far, {high} high, {len(self.nodes)} of {count} planned)"

    # building ----------------------------------------------------------------------------------
    @classmethod
    def build(
        cls,
        robot: Robot,
        distances: Sequence[float],
        heights: Sequence[float],
        *,
        folder: str | Path | None = None,
        jobs: int = 1,
        progress: bool | None = None,
        **arguments: Any,
    ) -> Atlas:
        """Plan the grid of ``distances`` and ``heights`` [m].

        Parameters
        ----------
        folder : where ``atlas.npz`` is written; an unfinished one is gone on with, and a finished
            one read.
        jobs, progress : as of :func:`.study.open_study`.
        arguments : further ones of :class:`jumplab.Planner`: terms, weights, off, limits, mesh,
            keep (True).

        Raises
        ------
        InputError
            If the grid is empty, not rising or too large, or ``folder`` holds an atlas of something
            else.
        """
        distances = _axis("distances", distances)
        heights = _axis("heights", heights)
        if len(distances) * len(heights) > MAX_CELLS:
            raise InputError(
                f"the atlas has {len(distances)} x {len(heights)} nodes, at most {MAX_CELLS}"
            )
        planner = Planner(robot, **{"keep": True} | arguments)
        atlas = cls(robot.name, distances, heights, {}, key_of_plans(planner.stage("direct")))
        path = None if folder is None else Path(folder, FILE)
        if path and path.exists():
            there = cls.load(folder)
            if there.key != atlas.key:
                raise InputError(
                    f"{str(path)!r} holds an atlas of robot {there.robot} that does not fit "
                    f"{robot.name}: robot, limits, terms or mesh differ; choose another folder"
                )
            if (there.distances, there.heights) != (atlas.distances, atlas.heights):
                raise InputError(
                    f"{str(path)!r} has another grid of distances and heights; choose another "
                    f"folder"
                )
            return there

        grid = [[JumpTask(distance, height) for distance in distances] for height in heights]
        work = partial(node_row, planner)
        known = "node", atlas.key
        rows = plan_rows(
            grid, work, known, "planned", folder, "atlas", jobs=jobs, progress=progress
        )
        for task, row in rows:
            if row and row["planned"]:
                place = task.distance_m, task.height_m
                atlas.nodes[place] = Node(*place, row["cost"], np.array(row["x"]))
        if folder is not None:
            atlas.save(folder)
        return atlas

    # use ---------------------------------------------------------------------------------------
    def starts(self, task: JumpTask) -> list[Node]:
        """Motions (n,) to begin with: the blend of the four nodes around the target if all are
        there, then the nearest.

        Empty for targets outside, for platforms, flips, other gravity and jumps out of the plane.
        """
        plain = replace(task, distance_m=0.0, height_m=0.5) == JumpTask(0.0, 0.5)
        places = (self.distances, task.distance_m), (self.heights, task.height_m)
        if not plain or any(not x[0] - 1e-9 <= value <= x[-1] + 1e-9 for x, value in places):
            return []
        across, up = (_around(*place) for place in places)
        shares = {(d, h): a * b for d, a in across.items() for h, b in up.items()}
        nodes = {place: self.nodes[place] for place in shares if place in self.nodes}
        if not nodes:
            return []
        nearest = nodes[max(nodes, key=shares.get)]
        if len(nodes) == 1 or nodes.keys() != shares.keys():
            return [nearest]
        cost = sum(shares[place] * node.cost for place, node in nodes.items())
        x = sum(shares[place] * node.x for place, node in nodes.items())
        return [replace(nearest, cost=cost, x=x), nearest]

    def require(self, body: WholeBodyPlanner) -> None:
        """Raise :class:`InputError` unless plans of ``body`` (a direct planner) are made of the
        same.
        """
        if key_of_plans(body) != self.key:
            raise InputError(
                f"the atlas of robot {self.robot} does not fit this planner of "
                f"{body.robot.name}: robot, limits, terms or mesh differ; build an atlas for "
                f"this planner, or leave it out"
            )

    def solve(
        self, body: WholeBodyPlanner, task: JumpTask, start: np.ndarray | None = None
    ) -> WholeBodyPlan | None:
        """The direct plan for a target from the nodes around it; None if they lead nowhere.

        ``body`` as of :meth:`require`, which is called; ``start`` (nq,) is where the robot waits.
        """
        self.require(body)
        plans = {}  # by their costs
        for node in self.starts(task):
            phases = unpack(body.program(AHEAD).nlp.assembled, node.x)
            near = {name: phase.guess() for name, phase in phases.items()}
            with suppress(SolverError), unexplained():  # the node may not be that close
                plan = body.plan(task, near=near, stance=start, starts=FROM_NEIGHBOUR[:1])
                cost = plan.solution.statistics.objective
                plans.setdefault(cost, plan)
                if cost <= MIXED * node.cost:
                    break
        return plans[min(plans)] if plans else None

    @property
    def hash(self) -> str:
        """Short hash of what its plans begin with."""
        costs = [[*place, node.cost] for place, node in self.nodes.items()]
        return short_hash([self.key, self.distances, self.heights, costs])

    # file --------------------------------------------------------------------------------------
    def save(self, folder: str | Path) -> Path:
        """Write ``atlas.npz`` (its head as JSON, motions (nodes, n)) into ``folder``; returns its
        path.
        """
        nodes = list(self.nodes.values())
        head = {
            "format": FORMAT,
            "robot": self.robot,
            "key": self.key,
            "distances": self.distances,
            "heights": self.heights,
            "nodes": [(n.distance_m, n.height_m, n.cost) for n in nodes],
        }
        rows = np.array([n.x for n in nodes])
        np.savez_compressed(buffer := io.BytesIO(), head=json.dumps(head), rows=rows)
        folder = Path(folder)
        with made(folder), locked(folder):
            return write_file(folder / FILE, buffer.getvalue())

    @classmethod
    def load(cls, folder: str | Path) -> Atlas:
        """The atlas of a ``folder`` (that of :meth:`save`); raises :class:`InputError` if there is
        none, or it is damaged.
        """
        path = Path(folder) / FILE
        try:
            file = reading.arrays(reading.content(path, "arrays", link=False))
            head = json.loads(str(file["head"]))
            rows = file["rows"]
            if head["format"] != FORMAT or not np.all(np.isfinite(rows)):
                raise ValueError("unknown format, or numbers that are not finite")
            # more than these three numbers was kept once
            nodes = [Node(*node[:3], x) for node, x in zip(head["nodes"], rows, strict=True)]
            places = {(node.distance_m, node.height_m): node for node in nodes}
            return cls(head["robot"], head["distances"], head["heights"], places, head["key"])
        except FileNotFoundError:
            raise InputError(
                f"{str(path.parent)!r} has no {FILE}; build one with 'jumplab atlas'"
            ) from None
        except (*reading.DAMAGE, IndexError) as e:
            raise InputError(
                f"{str(path)!r} is damaged or no atlas ({type(e).__name__}); "
                f"delete it and build it again"
            ) from None


def key_of_plans(body: WholeBodyPlanner) -> str:
    """Fingerprint of all that decides plans of a direct planner."""
    problem = body.program(AHEAD).nlp.problem
    words = [part.words(problem) for part in parts(problem)]
    mesh = sorted(body.mesh.intervals().items())
    weights = [term.weight for _, term in problem.terms()]
    values = body.robot.hash, body.limits, body.weights, weights, problem.table(), mesh
    return fingerprint(words, " ".join(map(str, values)))


def _axis(name: str, values: Sequence[float]) -> tuple[float, ...]:
    values = tuple(round(float(x), 9) for x in values)
    if not values or list(values) != sorted(set(values)):
        raise InputError(
            f"the {name} of an atlas must be one or more numbers in rising order, got "
            f"{quoted(values)}"
        )
    return values


def _around(axis: Sequence[float], x: float) -> dict[float, float]:
    """The values of a rising ``axis`` around ``x``, one or two, and the share of each."""
    place = round(float(np.interp(x, axis, range(len(axis)))), 9)
    below = int(place)
    above = place - below
    return {axis[below]: 1 - above} | ({axis[below + 1]: above} if above else {})


def node_row(planner: Planner, task: JumpTask) -> Plain:
    """The row of a target with its motion, an array ``x`` of all unknowns, if it has a plan."""
    planner = here(planner)
    row, plan = plan_cell(planner, task)
    if plan is not None:
        body = planner.stage("direct")
        motion = plan.whole_body.solution.guess(body.mesh.intervals())  # perhaps of a finer mesh
        row["x"] = pack(body.program(AHEAD).nlp.assembled, motion).tolist()
    return row
