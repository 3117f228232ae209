"""Four processes with four threads each at everything at once: every result is the one of a single thread."""

from __future__ import annotations

import hashlib
import json
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
WORKS: tuple[str, ...] = ()  # names of those that are done, all if there are none
TARGETS = jl.JumpTask(0.3, 0.2), jl.JumpTask(0.4, 0.3), jl.JumpTask(0.2, 0.2, side_m=0.1)


def digest(*results: Any) -> str:
    """Hash of arrays, texts and nested mappings, to the bit but for the sign of zeros."""
    seen = hashlib.sha256()
    for x in results:
        if isinstance(x, dict):
            x = digest(*[part for key in sorted(x) for part in (key, x[key])])
        if isinstance(x, np.ndarray) and x.dtype.kind == "f":
            x = x + 0.0  # a zero has no sign
        seen.update(x.tobytes() if isinstance(x, np.ndarray) else repr(x).encode())
    return seen.hexdigest()[:16]


class Works:
    """What threads do, by name: (work, that returns a digest; about how long it takes [s])."""

    def __init__(self, folder: Path):
        self.source = good(folder) / "jump"
        self.plan, self.run = jl.load(self.source)
        self.planner = jl.Planner(self.plan.robot, keep=True)  # of all threads of a process
        self.folder, self.shared = folder, folder / "shared"  # of all processes
        self.all: dict[str, tuple[Callable[[], str], float]] = {
            **{f"plan {k}": (lambda k=k: digest(jl.plan(TARGETS[k]).tape.arrays()), (4, 4, 9)[k]) for k in range(3)},
            "shared planner": (lambda: digest(self.planner.plan(TARGETS[1]).tape.arrays()), 3),
            "another": (lambda: digest(self.planner.plan(TARGETS[0]).tape.arrays()), 3),
            "three steps": (lambda: digest(jl.plan(TARGETS[1], method="three-step").tape.arrays()), 8),
            "bullet": (lambda: digest(jl.simulate(self.plan, engine="bullet", stand_s=0.2).arrays()), 2),
            "mujoco": (lambda: digest(jl.simulate(self.plan, engine="mujoco", stand_s=0.2).arrays()), 2),
            "audit": (lambda: digest(jl.load(self.source).plan.audit.to_json()), 1),
            "folder": (self.written, 1),
            "page": (lambda: digest(jl.plots.page(self.plan.robot, plan=self.plan.tape, task=self.plan.task).html), 1),
            "figure": (self.drawn, 1),
            "trials": (self.tried, 15),
            "map": (self.mapped, 8),
        }
        self.all = {name: self.all[name] for name in WORKS or self.all}

    def written(self) -> str:
        """One folder that everybody writes and reads."""
        jl.save(self.shared, self.plan, self.run)
        saved = jl.load(self.shared)
        return digest(saved.plan.tape.arrays(), saved.run.arrays() if saved.run else {})

    def drawn(self) -> str:
        place = Path(mkdtemp(dir=self.folder))
        jl.plots.save_figure(jl.plots.margins(self.plan.tape, self.plan.robot), "margins", place)
        return digest(sorted(p.name for p in place.iterdir()), (place / "margins.png").read_bytes())

    def tried(self) -> str:
        place = Path(mkdtemp(dir=self.folder))
        jl.save(place, self.plan)
        trials = jl.run_trials(place, 2, jobs=2, progress=False).trials
        return digest(*[json.dumps(trial.to_json(), sort_keys=True) for trial in trials])

    def mapped(self) -> str:
        cells = envelope(self.plan.robot, [0.3, 0.4], [0.2], jobs=2, progress=False).cells
        return digest(*[(c.distance_m, c.solved, c.iterations, c.limiting, c.share) for c in cells])


def together(folder: Path) -> Callable:
    """Cases: a minute each of all works by all threads."""
    works = Works(folder)
    answers = folder / "alone.json"
    if not answers.exists():
        answers.write_text(json.dumps({name: work() for name, (work, _) in works.all.items()}))
    alone = json.loads(answers.read_text())
    names = list(works.all)
    weights = [1.0 / about_s for _, about_s in works.all.values()]

    def thread(rng: random.Random, until: float, rows: list) -> None:
        while time.monotonic() < until:
            name = rng.choices(names, weights)[0]
            try:
                end = "equal" if works.all[name][0]() == alone[name] else "another result"
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
