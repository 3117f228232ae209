"""Drawn faults: one wrong argument of any public function, and one damaged file of a result folder."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from shots import good
from test_trust import FIT, SLOW, WRONG, public, takes

import jumplab as jl
from jumplab.cli import main as cli
from jumplab.errors import JumplabError
from jumplab.io import folder as store
from jumplab.sim import Ranges, Scene
from jumplab.studies.chain import Course
from jumplab.studies.trials import TrialSettings

Row = dict[str, str]
COMMANDS_S = 90  # processor time of all commands on a damaged folder
LONGEST_S = 4  # processor time of a call, after which it counts as taken
MEMORY_BYTES, MOST_CHARACTERS = 4 << 30, 300  # of the process; of a message
MORE = [float("nan"), float("inf"), -1.0, -3, True, [], (), "left", "\0", Path("/dev/null"), np.zeros(0), np.float32(2),
        np.zeros((3, 3, 3)), 1.5, 10**9, 0, np.nan * np.zeros(3), {"a": {"b": 1}}, {1: 2}, [None], b""]  # fmt: skip
# functions that may take long if the argument is not wrong after all: a process each
LONG = (*SLOW, "Planner.follow", "Planner.prepared", "Planner.program", "envelope", "view", "plots.movie", "plots.page")
# of functions that hand their options on
OPTIONS = {
    "plan": dict(terms=None, weights=None, off=(), limits=None, settings=None, mesh=None),
    "judge": dict(fps=None, order="depth-first"),
    "mend": dict(fps=None, order="depth-first", weights=None, limits=None),
    "simulate": dict(mode="position", perturbation=None, scene=None, feedback=False, reaim=True, step=False,
                     landing="spring", stand_s=0.1, engine="mujoco", contact="hard"),
    "record": dict(terms=None, weights=None, off=(), limits=None, mesh=None),
    "Atlas.build": dict(weights=None, limits=None, mesh=None),
    "plots.by_phase": dict(color="#102030", linewidth=1.0),
    "plots.compare": dict(color="#102030", linewidth=1.0),
}  # fmt: skip


def forked(work: Callable[[], Row], folder: Path, longest_s: int = LONGEST_S) -> Row:
    """Result of ``work`` in a process of its own; one that dies of its time is "long", of anything else "dead"."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        with contextlib.suppress(BaseException):
            os.chdir(folder)
            used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
            resource.setrlimit(resource.RLIMIT_CPU, (int(used) + longest_s, int(used) + longest_s))
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            os.write(writing, json.dumps(work()).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        said = file.read()
    status = os.waitpid(child, 0)[1]
    if said:
        return json.loads(said)
    long = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
    return {"end": "long", "fault": ""} if long else {"end": "dead", "fault": f"ends with {status}"}


# wrong calls --------------------------------------------------------------------------------------------------------
def calls(folder: Path) -> Callable:
    """One wrong argument, options included: refused in a sentence, or taken; nothing else, in little memory."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    plan, run = jl.load(good(folder) / "jump")
    robot, tape = plan.robot, plan.tape
    functions = public(robot, slow=True)
    functions |= {f"JumpPlan.{name}": getattr(plan, name) for name in ("line", "terms") if takes(getattr(plan, name))}
    ax = jl.plots.new_figure().subplots()
    fit = FIT | dict(
        robot=robot, ax=ax, axes=[ax], fig=ax.figure, folder=folder / "none", task=plan.task, plan=plan, run=run,
        tape=tape, record=run, body=jl.plots.Silhouette(robot), result=run, x=plan, name_or_path="bhr", urdf=robot.urdf,
        config_text=robot.config_text, motion=good(folder) / "clip.npz", previous=plan, rows=[{"a": 1.0}], q=tape.q[0],
        strength=1.0, place=np.zeros(2), t=tape.t, y=tape.t, phase=tape.phase, angles=np.zeros(5), left=0.0, right=1.0,
        times=[0.1], handles=[], frames=tape.q[:3], colors=["#102030"] * 3, places=np.zeros((3, 2)), name="x", of=plan,
        contacts=jl.Contacts.hop(robot), scene=Scene.flat(), point=np.zeros(3), points=np.zeros((2, 3)),
        summary=plan.summary, course=Course([plan.task]), settings=TrialSettings(), what="height_m",
        phases=jl.Contacts.hop(robot).phases, words="hop=0.1", nodes={}, key="x", equation="x", unit="m", at="motion",
        expression="1", curve=(tape.t, tape.t), envelope=None, model=robot.sagittal, seed=0, x_m=0.1, ranges=Ranges(),
    )  # fmt: skip
    names = sorted(functions)

    def case(number: int, rng: random.Random) -> Row:
        name = names[number % len(names)]
        usual = {k: None if p.default is p.empty else p.default for k, p in takes(functions[name]).items()}
        arguments = {k: fit.get(k, value) for k, value in usual.items()} | OPTIONS.get(name, {})
        if name == "plan":
            arguments |= {"contacts": None, "settings": None, "patience_s": 1.0}
        wrong, value = rng.choice(list(arguments)), rng.choice(WRONG + MORE)
        call = partial(outcome, functions[name], arguments | {wrong: value})
        row = forked(call, folder) if name in LONG else call()
        return {"call": f"{name}({wrong}={value!r:.60})"} | row

    return case


def outcome(function: Callable, arguments: dict[str, Any]) -> Row:
    try:
        function(**arguments)
    except JumplabError as e:
        long = len(str(e)) > MOST_CHARACTERS or "\n" in str(e)
        return {"end": "refused", "fault": f"{len(str(e))} characters: {e}" if long else ""}
    except Exception as e:
        return {"end": "bare", "fault": f"{type(e).__name__}: {e}"[:500]}
    return {"end": "taken", "fault": ""}


# damaged folders ----------------------------------------------------------------------------------------------------
VALUES = [None, True, "x", "", -1, 0, 1e308, float("nan"), float("inf"), [], {}, [1], "x" * 5000, 10**40, {"a": 1}]
WORDS = ["nan", "inf", "-1", "", "x", "1e400"]
BARE = re.compile(rb"(?<![A-Za-z_])(nan|-?inf|NaN|-?Infinity)(?![A-Za-z_])")
SUFFIX = {"csv": ".csv", "npz": ".npz", "pkl": ".pkl"}


def folders(folder: Path) -> Callable:
    """One damaged file, its sum renewed or not: every command ends with 0, 2 or 3, and exports no infinity."""
    source = good(folder)

    def case(number: int, rng: random.Random) -> Row:
        place = Path(tempfile.mkdtemp(prefix=f"damaged-{number}-", dir=folder))
        shutil.copytree(source / "jump", place / "jump")
        what = damaged(rng, place / "jump")
        if sealed := rng.random() < 0.6:
            with contextlib.suppress(Exception):
                seal(place / "jump")
        what += " (sealed)" if sealed else ""
        formats = rng.sample(list(store.FORMATS), 2)
        commands = [["audit", "jump"], ["view", "jump", "--out", "out/page.html"], ["judge", "jump"]]
        for name, simulated in zip(formats, ([], ["--simulated"]), strict=True):
            out = f"out/{name}{SUFFIX.get(name.rpartition('-')[2], '')}"
            commands.append(["export", "jump", "--format", name, "--out", out, *simulated])
        rng.shuffle(commands)
        commands.append(["simulate", "jump"] if number % 10 == 0 else ["audit", "jump"])
        row = forked(lambda: ends(commands, place), place, COMMANDS_S)
        if row["end"] == "long":
            row["fault"] = f"more than {COMMANDS_S} s"
        if not row["fault"]:
            shutil.rmtree(place)
        return {"damage": what} | row

    return case


def ends(commands: list[list[str]], place: Path) -> Row:
    codes, faults = [], []
    for argv in commands:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            codes.append(cli.main(argv))
        if codes[-1] not in (0, 2, 3) or err.getvalue().count("\n") > 1:
            faults.append(f"{' '.join(argv)}: {codes[-1]}, {err.getvalue()[:300]}")
    files = (place / "out").rglob("*") if (place / "out").exists() else ()
    faults += [f"{path.name} has infinities" for path in files if path.is_file() and infinite(path)]
    return {"end": " ".join(map(str, sorted(set(codes)))), "fault": "; ".join(faults)}


def infinite(path: Path) -> bool:
    if path.suffix in (".npz", ".pkl"):
        return not finite(joblib.load(path) if path.suffix == ".pkl" else dict(np.load(path, allow_pickle=False)))
    return path.suffix in (".csv", ".json", ".xml", ".urdf") and bool(BARE.search(path.read_bytes()))


def finite(x: Any) -> bool:
    """Whether all numbers in nested mappings, sequences and arrays are."""
    if isinstance(x, dict | list | tuple):
        return all(map(finite, x.values() if isinstance(x, dict) else x))
    kind = np.asarray(x).dtype.kind
    return kind not in "fc" or bool(np.isfinite(x).all())


def damaged(rng: random.Random, folder: Path) -> str:
    """Damage one file; in words."""
    path = folder / rng.choice(sorted(p.name for p in folder.iterdir()))
    raw, kind = path.read_bytes(), rng.random()
    if kind < 0.08:
        path.unlink()
        return f"{path.name} gone"
    if kind < 0.2:
        path.write_bytes(raw[: rng.randrange(len(raw))])
        return f"{path.name} cut"
    if kind < 0.35:
        new = bytearray(raw)
        for _ in range(rng.randint(1, 20)):
            new[rng.randrange(len(new))] = rng.randrange(256)
        path.write_bytes(new)
        return f"bytes of {path.name}"
    if path.suffix == ".json":
        data = json.loads(raw)
        what = poked(rng, data)
        path.write_text(json.dumps(data))
        return f"{path.name}: {what}"
    if path.suffix == ".npz":
        return f"{path.name}: {changed(rng, path)}"
    words = raw.decode().split(" ")
    words[rng.randrange(len(words))] = rng.choice(WORDS)
    path.write_text(" ".join(words))
    return f"word of {path.name}"


def poked(rng: random.Random, data: Any) -> str:
    """Delete or replace one leaf or branch of JSON data."""
    way, node = [], data
    while isinstance(node, dict | list) and node and (not way or rng.random() < 0.75):
        parent = node
        way.append(rng.choice(list(node) if isinstance(node, dict) else range(len(node))))
        node = node[way[-1]]
    if rng.random() < 0.3 and isinstance(parent, dict):
        del parent[way[-1]]
        return f"without {way}"
    parent[way[-1]] = rng.choice(VALUES)
    return f"{way} = {parent[way[-1]]!r:.30}"


def changed(rng: random.Random, path: Path) -> str:
    """Change one array of a file: its values, shape or kind."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {k: file[k] for k in file.files}
    name, how = rng.choice(list(arrays)), rng.randrange(7)
    x = arrays.pop(name)
    if how == 2 and x.dtype.kind == "f" and x.size:
        x = np.array(x)
        x.flat[rng.randrange(x.size)] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
    others = [None, x[:-1] if x.ndim else x, x, x.astype("U"), np.zeros(0), x[None], x[::-1] if x.ndim else "zz"]
    if how:
        arrays[name] = np.asarray(others[how])
    np.savez(path, **arrays)
    return f"{name}, change {how}"


def seal(folder: Path) -> None:
    """Renew the sums that a manifest has of its files, so that the damage itself is met."""
    for file, entry in ((store.SUMMARY, None), ("passport.json", "plan_sha256")):
        data = json.loads((folder / file).read_text())
        if entry:
            data["manifest"][entry] = store.sha256(folder / store.PLAN)
        else:
            data["manifest"]["files"] = {name: store.sha256(folder / name) for name in store.HASHED}
        (folder / file).write_text(json.dumps(data))
