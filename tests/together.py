"""Four processes with four threads each at everything at once: every result is the one of a single thread."""

from __future__ import annotations

import json
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from shots import good

import jumplab as jl
from jumplab.studies.envelope import envelope

PROCESSES, THREADS, ROUND_S = 4, 4, 60.0
SAME = 1e-7
WORKS: tuple[str, ...] = ()  # names of those that are done, all if there are none
TARGETS = jl.JumpTask(0.3, 0.2), jl.JumpTask(0.4, 0.3), jl.JumpTask(0.2, 0.2, side_m=0.1)


def alike(one: Any, other: Any) -> bool:
    """Whether arrays, texts and nested rows of them are the same, numbers to :data:`SAME`: a QP's last digits depend on
    where its arrays lie in memory, in one thread too.
    """
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    x, y = np.asarray(one), np.asarray(other)
    if x.dtype.kind == "f":
        return x.shape == y.shape and np.allclose(x, y, rtol=SAME, atol=SAME, equal_nan=True)
    return np.array_equal(x, y)


class Works:
    """The works of threads, by name: (work, about how long it takes [s])."""

    def __init__(self, folder: Path):
        self.source = good(folder) / "jump"
        self.plan, self.run = jl.load(self.source)
        self.planner = jl.Planner(self.plan.robot, keep=True)  # of all threads of a process
        self.folder, self.shared = folder, folder / "shared"  # of all processes
        self.all: dict[str, tuple[Callable[[], Any], float]] = {
            **{f"plan {k}": (lambda k=k: jl.plan(TARGETS[k]).tape.arrays(), (4, 4, 9)[k]) for k in range(3)},
            "shared planner": (lambda: self.planner.plan(TARGETS[1]).tape.arrays(), 3),
            "another": (lambda: self.planner.plan(TARGETS[0]).tape.arrays(), 3),
            "three steps": (lambda: jl.plan(TARGETS[1], method="three-step").tape.arrays(), 8),
            "bullet": (lambda: jl.simulate(self.plan, engine="bullet", stand_s=0.2).arrays(), 2),
            "mujoco": (lambda: jl.simulate(self.plan, engine="mujoco", stand_s=0.2).arrays(), 2),
            "audit": (lambda: jl.load(self.source).plan.audit.to_json(), 1),
            "folder": (self.written, 1),
            "page": (lambda: jl.plots.page(self.plan.robot, plan=self.plan.tape, task=self.plan.task).html, 1),
            "figure": (self.drawn, 1),
            "trials": (self.tried, 15),
            "map": (self.mapped, 8),
        }
        self.all = {name: self.all[name] for name in WORKS or self.all}

    def written(self) -> list:
        """One folder that everybody writes and reads."""
        jl.save(self.shared, self.plan, self.run)
        saved = jl.load(self.shared)
        # another one may just have written its plan, and not yet its simulation
        return [saved.plan.tape.arrays(), (saved.run or self.run).arrays()]

    def drawn(self) -> list:
        place = Path(mkdtemp(dir=self.folder))
        jl.plots.save_figure(jl.plots.margins(self.plan.tape, self.plan.robot), "margins", place)
        return [sorted(p.name for p in place.iterdir()), (place / "margins.png").read_bytes()]

    def tried(self) -> list:
        place = Path(mkdtemp(dir=self.folder))
        jl.save(place, self.plan)
        trials = jl.run_trials(place, 2, jobs=2, progress=False).trials
        return [trial.to_json() for trial in trials]

    def mapped(self) -> list:
        cells = envelope(self.plan.robot, [0.3, 0.4], [0.2], jobs=2, progress=False).cells
        return [(c.distance_m, c.solved, c.iterations, c.limiting, c.share) for c in cells]


def together(folder: Path) -> Callable:
    """Cases: a minute each of all works by all threads."""
    works = Works(folder)
    alone = {name: work() for name, (work, _) in works.all.items()}
    names = list(works.all)
    weights = [1.0 / about_s for _, about_s in works.all.values()]

    def thread(rng: random.Random, until: float, rows: list) -> None:
        while time.monotonic() < until:
            name = rng.choices(names, weights)[0]
            try:
                end = "equal" if alike(works.all[name][0](), alone[name]) else "another result"
            except BaseException as e:
                end = f"{type(e).__name__}: {e}"[:300]
            rows.append((name, end))

    def process(seed: float, out: Path) -> None:
        rows, until = [], time.monotonic() + ROUND_S
        threads = [
            threading.Thread(target=thread, args=(random.Random(f"{seed} {k}"), until, rows)) for k in range(THREADS)
        ]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
        out.write_text(json.dumps(rows))
        os._exit(0)  # a forked process waits at its end for idle workers of joblib, which leave after five minutes

    def case(number: int, rng: random.Random) -> dict[str, Any]:
        place = Path(mkdtemp(dir=folder))
        outs = [place / f"{k}.json" for k in range(PROCESSES)]
        forks = [get_context("fork").Process(target=process, args=(rng.random(), out)) for out in outs]
        for fork in forks:
            fork.start()
        for fork in forks:
            fork.join()
        rows = [row for out in outs if out.exists() for row in json.loads(out.read_text())]
        faults = [f"a process ended with {fork.exitcode}" for fork in forks if fork.exitcode]
        faults += [f"{name}: {end}" for name, end in rows if end != "equal"]
        done = dict(sorted(Counter(name for name, _ in rows).items()))
        return {"done": done, "calls": len(rows), "end": "equal" if not faults else "not", "fault": "; ".join(faults)}

    return case
