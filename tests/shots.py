"""Every command, sent a signal at a moment that is drawn in seconds of its processor time, those of its workers included."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import psutil

import jumplab as jl
from jumplab.cli import main as cli
from jumplab.io import folder as store

ROOT = Path(__file__).resolve().parent.parent
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}
LOGS = ".jsonl"  # finished pieces of work are kept
LOOK_S, FAMILY = 0.01, 10  # children are looked for at every tenth look
ORPHAN_S, LONGEST_S, AGAIN_S = 30.0, 900.0, 6.0
# by name: a command, in a place that holds the folder of a plan and its simulation, and about how long it takes [s]
COMMANDS = {
    "plan": ("plan --distance-m 0.4 --height-m 0.25 --out jump", 5),
    "three steps": ("plan --method three-step --distance-m 0.4 --height-m 0.25 --out jump", 8),
    "aside": ("plan --side-m 0.1 --distance-m 0.2 --height-m 0.2 --out new", 10),
    "audit": ("audit jump", 2.5),
    "simulate": ("simulate jump --mode pd", 9),
    "mujoco": ("simulate jump --engine mujoco", 8),
    "trials": ("trials jump --n 2 --jobs 2", 20),
    "margins": ("margins jump --n 1 --steps 0 --disturb friction --jobs 1", 20),
    "certify": ("certify jump --n 1 --jobs 2", 40),
    "view": ("view jump", 3),
    "movie": ("view jump --movie jump.gif", 8),
    "export": ("export jump --format npz --out new.npz", 2.5),
    "replay": ("export jump --format urdf-replay --simulated", 3),
    "judge": ("judge clip.npz --out new", 4),
    "mend": ("mend clip.npz --out new", 30),
    "chain": ("chain --distance-m 0.3,0.3 --height-m 0.2 --out new", 20),
    "clips": ("clips --out new --only forward-1 --jobs 1", 12),
    "record": ("record bhr distance_m --height-m 0.2 --out new", 20),
    "envelope": ("envelope --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --out new", 9),
    "atlas": ("atlas --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --out new", 9),
    "sweep": ("sweep --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --tapes 50 --out new", 9),
    "bench": ("bench --repeats 1 --distance-m 0.4 --height-m 0.2 --out new.json", 12),
    "run": ("run 00 -p fast=true --out new", 20),
    "list": ("robot list", 1.2),
    "check": ("robot check g1 --out new", 5),
    "completion": ("completion bash", 1.0),
}


def start(name: str, place: Path) -> subprocess.Popen:
    """A command at work in ``place``; who runs the tests in the background may ignore Ctrl-C, it does not."""
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    python = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    how = dict(stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=heed, cwd=place)
    how["env"] = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": python}
    return subprocess.Popen([sys.executable, "-m", "jumplab", *COMMANDS[name][0].split()], **how)


def run_until(process: subprocess.Popen, cpu_s: float) -> tuple[float, list[psutil.Process]]:
    """Let a command work until it has used so much processor time, or ended; what it used, and its children."""
    own, children, used_s, looks = psutil.Process(process.pid), {}, 0.0, 0
    while process.poll() is None and used_s < cpu_s:
        with suppress(psutil.Error):
            if looks % FAMILY == 0:
                children |= {child.pid: child for child in own.children(recursive=True)}
            used_s = max(used_s, sum(map(spent_s, [own, *children.values()])))
        looks += 1
        time.sleep(LOOK_S)
    return used_s, list(children.values())


def spent_s(process: psutil.Process) -> float:
    """Processor time of a process, and of those children that have ended and been waited for."""
    try:
        return sum(process.cpu_times()[:4])
    except psutil.Error:
        return 0.0


def content(place: Path) -> dict[str, bytes]:
    return {str(p.relative_to(place)): p.read_bytes() for p in place.rglob("*") if p.is_file()}


def kept(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: raw for name, raw in files.items() if not name.endswith(LOGS)}


def good(folder: Path) -> Path:
    """A place with a result folder and a clip, which is copied for every shot."""
    place = folder / "good"
    if not place.exists():
        plan = jl.plan(jl.JumpTask(0.3, 0.2))
        jl.save(place / "jump", plan, jl.simulate(plan, stand_s=0.2))
        argv = ["export", str(place / "jump"), "--format", "mjlab-npz", "--out", str(place / "clip.npz")]
        assert cli.main(argv) == 0
    return place


def faults_of_end(code: int, number: signal.Signals, said: str) -> list[str]:
    """One sentence at most, and an exit code that is documented, or the signal's own while Python itself starts."""
    starting = code == -number or (code == CODES[number] and not said)
    if "KeyboardInterrupt" in said and not re.search(r'jumplab/__main__\.py", line \d+, in main\n', said):
        said, starting = "", True
    faults = [f"says {said[-300:]!r}"] if "Traceback" in said or said.count("\n") > 1 else []
    return faults + ([] if starting or code in (0, CODES[number]) else [f"ends with {code}"])


def faults_of_folders(place: Path) -> list[str]:
    """Every result folder speaks of one and the same plan."""
    faults = []
    for path in [place / name for name in ("jump", "new")]:
        if not (path / store.SUMMARY).exists():
            continue
        try:
            saved = jl.load(path)  # checks the hashes of plan and robot
            seal = store.read_json(path / "passport.json")["manifest"]
            if seal["plan_sha256"] != saved.plan.summary["manifest"]["files"][store.PLAN]:
                faults.append(f"{path.name}: audit of another plan")
            if saved.run is not None:
                told = store.read_json(path / "simulation.json")["planned_rise_m"]
                if told != saved.plan.summary["planned_rise_m"]:
                    faults.append(f"{path.name}: simulation of another plan")
        except Exception as e:
            faults.append(f"{path.name}: {e}")
    return faults


def orphans(children: list[psutil.Process]) -> list[str]:
    """Processes that outlive the command by more than half a minute."""
    _, alive = psutil.wait_procs(children, timeout=ORPHAN_S)
    return [f"process {m.pid} lives on" for m in alive]


def shots(folder: Path, numbers: Sequence[signal.Signals]) -> Callable:
    """Cases: one command each, every one in turn and then the quick ones more often, at a drawn moment of its work."""
    source, names = good(folder), list(COMMANDS)
    weights = [1.0 / about_s for _, about_s in COMMANDS.values()]

    def shot(k: int, rng: random.Random) -> dict[str, Any]:
        name = names[k] if k < len(names) else rng.choices(names, weights)[0]
        number, at_s = rng.choice(numbers), rng.uniform(0.0, COMMANDS[name][1])
        place = Path(mkdtemp(prefix=f"shot-{k}-", dir=folder))
        shutil.copytree(source, place, dirs_exist_ok=True)
        before = kept(content(place))
        process = start(name, place)
        used_s, children = run_until(process, at_s)
        process.send_signal(number)
        said = process.communicate(timeout=LONGEST_S)[1]
        code = process.returncode
        faults = faults_of_end(code, number, said) + orphans(children) + faults_of_folders(place)
        if number != signal.SIGKILL and code and (changed := differences(kept(content(place)), before)):
            faults.append(f"changed {changed}")
        if number == signal.SIGKILL and (COMMANDS[name][1] <= AGAIN_S or k < len(names)):
            again = start(name, place)
            said = again.communicate(timeout=LONGEST_S)[1]
            if again.returncode or said:
                faults.append(f"again: {again.returncode}, {said[-300:]!r}")
            if hidden := [file for file in content(place) if "/." in f"/{file}"]:
                faults.append(f"again: left {hidden}")
        if not faults:
            shutil.rmtree(place)
        end = "late" if code == 0 else "early" if code == -number != -9 else "heard"
        row = {"command": name, "at_s": round(used_s, 3), "end": f"{number.name} {end}"}
        return row | {"fault": "; ".join(faults)}

    return shot


def differences(one: dict[str, bytes], other: dict[str, bytes]) -> list[str]:
    """Names of files that are not the same in both."""
    return sorted(name for name in set(one) | set(other) if one.get(name) != other.get(name))


def signals(folder: Path) -> Callable:
    """Ctrl-C and SIGTERM: what was there is there unchanged, or the new result is whole."""
    return shots(folder, [signal.SIGINT, signal.SIGTERM])


def kills(folder: Path) -> Callable:
    """SIGKILL: every result folder is whole, and the command, done again, leaves no rest of the first."""
    return shots(folder, [signal.SIGKILL])
