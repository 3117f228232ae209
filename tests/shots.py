"""Every command, sent a signal at a moment that is drawn in seconds of its processor time, that of workers included.

Every fourth command is a new process; the others begin in a fork of this one, which has imported everything.
"""

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
from multiprocessing import get_context
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import psutil

import jumplab as jl
from jumplab import __main__ as console
from jumplab.cli import main as cli
from jumplab.io import folder as store

ROOT = Path(__file__).resolve().parent.parent
URDF = ROOT / "tests" / "mini.urdf"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}
LOGS = ".jsonl"  # finished pieces of work are kept, ...
TAPES = "/tapes/"  # ... and the motions that they list
LOOK_S, FAMILY = 0.01, 10  # children are looked for at every tenth look
ORPHAN_S, LONGEST_S = 60.0, 900.0
START_S = 1.5  # a new process imports for so long
SOON_S = 6.0  # most moments are drawn up to here: longer commands repeat themselves
AGAIN_S = 8.0  # commands that are quicker are done again after a kill
# by name: a command, in a place that holds the folder of a plan and its simulation, and about how long it works [s]
COMMANDS = {
    "plan": ("plan --distance-m 0.4 --height-m 0.25 --out jump", 4),
    "three steps": ("plan --method three-step --distance-m 0.4 --height-m 0.25 --out jump", 7),
    "aside": ("plan --side-m 0.1 --distance-m 0.2 --height-m 0.2 --out new", 8),
    "audit": ("audit jump", 1),
    "simulate": ("simulate jump --mode pd", 8),
    "mujoco": ("simulate jump --engine mujoco", 6),
    "trials": ("trials jump --n 2 --jobs 2", 20),
    "margins": ("margins jump --n 1 --steps 0 --disturb friction --jobs 1", 18),
    "certify": ("certify jump --n 1 --jobs 2", 40),
    "view": ("view jump", 1.5),
    "movie": ("view jump --movie jump.gif", 6),
    "export": ("export jump --format npz --out new.npz", 1),
    "replay": ("export jump --format urdf-replay --simulated", 1),
    "judge": ("judge clip.npz --out new", 2),
    "mend": ("mend clip.npz --out new", 25),
    "chain": ("chain --distance-m 0.3,0.3 --height-m 0.2 --out new", 18),
    "clips": ("clips --out new --only forward-1 --jobs 1", 10),
    "record": ("record bhr distance_m --height-m 0.2 --out new", 18),
    "envelope": ("envelope --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --out new", 8),
    "atlas": ("atlas --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --out new", 8),
    "sweep": ("sweep --distance-m 0.3,0.4 --height-m 0.2 --jobs 2 --tapes 50 --out new", 8),
    "bench": ("bench --repeats 1 --distance-m 0.4 --height-m 0.2 --out new.json", 10),
    "run": ("run 00 --out new", 20),
    "list": ("robot list", 0.3),
    "check": (f"robot check {URDF} --out new", 3),
    "completion": ("completion bash", 0.2),
}


class Command:
    """A command at work in ``place``, where stderr goes into a file beside it."""

    def __init__(self, name: str, place: Path, new: bool):
        self.said = place.with_suffix(".stderr")
        argv = COMMANDS[name][0].split()
        if new:
            python = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
            how = dict(stdout=subprocess.DEVNULL, cwd=place, preexec_fn=heed)
            how["env"] = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": python}
            with open(self.said, "w") as file:
                command = subprocess.Popen([sys.executable, "-m", "jumplab", *argv], stderr=file, **how)
            self.pid, self._poll = command.pid, command.poll
        else:
            fork = get_context("fork").Process(target=begin, args=(argv, place, self.said))
            fork.start()
            self.pid, self._poll = fork.pid, lambda: fork.exitcode

    def poll(self) -> int | None:
        """Exit code, or a signal's negative number, or None while it works."""
        return self._poll()

    def end(self) -> tuple[int, str]:
        """Wait for its end; exit code and what it said on stderr."""
        until = time.monotonic() + LONGEST_S
        while self.poll() is None:
            assert time.monotonic() < until, "it does not end"
            time.sleep(LOOK_S)
        return self.poll(), self.said.read_text()


def heed() -> None:
    """Answer Ctrl-C: a shell that runs the tests in the background may ignore it; the command does not."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def begin(argv: list[str], place: Path, said: Path) -> None:
    """The command line in a fork."""
    heed()
    os.chdir(place)
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    sys.argv = ["jumplab", *argv]
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
    code = console.main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # what pytest or a study would do at the end of this process is not the command's


def run_until(process: Command, cpu_s: float) -> tuple[float, list[psutil.Process]]:
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
    lines = b"".join(raw for name, raw in files.items() if name.endswith(LOGS)).decode()
    listed = {name for name in files if TAPES in name and Path(name).stem in lines}
    return {name: raw for name, raw in files.items() if not name.endswith(LOGS) and name not in listed}


def good(folder: Path) -> Path:
    """A place with a result folder and a clip, which is copied for every shot; this process has then all imported."""
    place = folder / "good"
    plan = jl.plan(jl.JumpTask(0.3, 0.2))
    run = jl.simulate(plan, stand_s=0.2)
    if not place.exists():
        jl.save(place / "jump", plan, run)
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
    """Every result folder is of one and the same plan."""
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
    """Cases: one command each, every one in turn and then the quick ones more often, at a drawn moment of its work.

    A command that ends before its moment shows how long it really works: later moments for it are drawn within that.
    """
    source, names = good(folder), list(COMMANDS)
    lengths_s = {name: about_s for name, (_, about_s) in COMMANDS.items()}
    weights = [1.0 / max(1.0, about_s) for _, about_s in COMMANDS.values()]

    def shot(k: int, rng: random.Random) -> dict[str, Any]:
        name = names[k] if k < len(names) else rng.choices(names, weights)[0]
        longest_s = lengths_s[name] if rng.random() < 0.3 else min(SOON_S, lengths_s[name])
        number, at_s, new = rng.choice(numbers), rng.uniform(0.0, longest_s), k % 4 == 0
        place = Path(mkdtemp(prefix=f"shot-{k}-", dir=folder))
        shutil.copytree(source, place, dirs_exist_ok=True)
        before = kept(content(place))
        process = Command(name, place, new)
        used_s, children = run_until(process, at_s + new * START_S)
        if process.poll() is None:
            os.kill(process.pid, number)
        else:
            lengths_s[name] = min(lengths_s[name], max(used_s - new * START_S, LOOK_S))
        code, said = process.end()
        faults = faults_of_end(code, number, said) + orphans(children) + faults_of_folders(place)
        if number != signal.SIGKILL and code and (changed := differences(kept(content(place)), before)):
            faults.append(f"changed {changed}")
        if number == signal.SIGKILL and COMMANDS[name][1] <= AGAIN_S:
            again, said = Command(name, place, False).end()
            if again or said:
                faults.append(f"again: {again}, {said[-300:]!r}")
            if hidden := [file for file in content(place) if "/." in f"/{file}"]:
                faults.append(f"again: left {hidden}")
        process.said.unlink()
        if not faults:
            shutil.rmtree(place)
        end = "late" if code == 0 else "early" if code == -number != -9 else "heard"
        row = {"command": name, "new": new, "at_s": round(used_s, 3), "end": f"{number.name} {end}"}
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
