"""Seeded random bad input to the API and to the notebooks' parameters: one sentence, quickly, and nothing left behind.

The command line has its own in test_cli.py, damaged files theirs in test_trajectory.py and test_store.py. Nothing here
is plausible: every call must be refused.
"""

import dataclasses
import math
import os
import random
import time
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from fixtures_core import pendulum, planner
from paper import running
from papermill.iorw import load_notebook_node
from papermill.parameterize import parameterize_notebook
from test_store import make_tape

from jumplab.cli import notebooks
from jumplab.errors import JumplabError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import Scene, simulate_jump
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.planner import METHODS, Planner
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "notebooks").glob(notebooks.PATTERN))
SLOWEST_S = 10.0  # of the processor, that a refusal takes at most
FEW = 80  # cases per door
ROBOT = Robot.load()
SILLY = [None, True, "far", "", "\0", b"x", float("nan"), math.inf, -math.inf, 1e9, 10**400, 1j, [], {}, [1.0, 2.0],
         np.array([1.0, 2.0]), object(), print, "x" * 5000, "1,0", "½", "--", ("a",), {"a": 1}]  # fmt: skip


@cache
def good_tape() -> Tape:
    """A tape of the right shape that is no jump."""
    return make_tape(ROBOT)


def junk(rng: random.Random) -> str:
    return "".join(chr(rng.choice([*range(33, 127), 228, 8364, 128512])) for _ in range(rng.randint(1, 12)))


# ------------------------------------------------------------------------------------------ doors of the API
# each takes a generator and an empty folder, and returns a call that must be refused


def target(rng, folder):
    field = rng.choice(["distance_m", "height_m", "platform_m", "rotation_rad", "gravity"])
    bad = rng.choice([*SILLY, rng.choice([-1, 1]) * 10 ** rng.uniform(2, 300)])
    return lambda: JumpTask(**{"distance_m": 1.0, "height_m": 0.5, field: bad})


def robot_name(rng, folder):
    bad = rng.choice([None, 3, True, b"bhr", [], {}, 1.5, "", ".", "/", "/dev/null", "a\0b", junk(rng) + "?", "x" * 999,
                      str(folder), Path("nowhere.toml"), "BHR", "bhr "])  # fmt: skip
    return lambda: Robot.load(bad)


def plan_options(rng, folder):
    task, bad = JumpTask(1.0, 0.5), rng.choice(SILLY)
    quick = [
        lambda: Planner(ROBOT).plan(task, bad),
        lambda: Planner(ROBOT).plan(bad),
        lambda: Planner(bad).plan(task),
        lambda: Planner("bhr" if bad is None else bad),
        lambda: map_to_joints(bad, ROBOT),
        lambda: map_to_joints(pendulum(0.3, 0.2), ROBOT, step_s=bad),
    ]
    return rng.choice([
        *6 * quick,
        lambda: planner().plan(JumpTask(rng.choice([-1, 1]) * rng.uniform(2.8, 3.0), rng.uniform(0.02, 0.1))),
        lambda: planner().plan(JumpTask(0.5, rng.uniform(1.2, 1.5)), rng.choice(METHODS)),
    ])  # fmt: skip


def simulation(rng, folder):
    tape, bad = good_tape(), rng.choice([x for x in SILLY if not callable(x)])
    name = rng.choice(["t", "q", "v", "tau"])
    gap = np.array(getattr(tape, name))
    gap[rng.randrange(len(gap))] = rng.choice([math.nan, math.inf])
    return rng.choice([
        lambda: simulate_jump(tape, ROBOT, mode=bad),
        lambda: simulate_jump(bad, ROBOT),
        lambda: simulate_jump(tape, bad),
        lambda: simulate_jump(tape, ROBOT, stand_s=bad),
        lambda: simulate_jump(tape, ROBOT, scene=bad if bad is not None else 3),
        lambda: simulate_jump(tape, ROBOT, perturbation=bad if bad is not None else 3),
        lambda: simulate_jump(tape, ROBOT, landing=bad if bad is not None else 3),
        lambda: simulate_jump(dataclasses.replace(tape, **{name: gap}), ROBOT),
        lambda: simulate_jump(dataclasses.replace(tape, joint_names=tape.joint_names[::-1]), ROBOT),
        lambda: Scene.level("platform", {-rng.random(): 0.5}),
    ])  # fmt: skip


def runner(rng, folder):
    """``run_notebooks`` itself, over the package's notebooks."""
    name, bad = rng.choice([
        ("distance_m", rng.choice([None, True, "far", math.nan, 1e9, [], -3.01])),
        ("height_m", rng.choice([0, -1, "0.5", math.inf, 1.51, 1j])),
        ("robot", rng.choice(["", "asimo", None, 3, "a\0b", junk(rng) + "?"])),
        ("grid", rng.choice([0, 1, -3, 1.5, True, "6", 10**9, None])),
        ("samples", rng.choice([0, -1, 10**9, "many", 2.0])),
        ("targets", rng.choice([0, 201, -1, 1.5, None])),
        ("fast", rng.choice([0, 1, "yes", None])),
        (rng.choice(["out", "figures"]), "x"),
        ("no_such_" + str(rng.randrange(99)), 1),
    ])  # fmt: skip
    return rng.choice([
        *[lambda: run({name: bad})] * 6,
        lambda: run({}, out=rng.choice(["/dev/null/x", "/proc/x", "x\0", ""])),
        lambda: run({}, figures="/dev/null/x"),
        lambda: run(rng.choice([3, "distance_m=1", [1]])),
        lambda: running.run_notebooks({}, notebooks=[folder / "none.ipynb"], out=folder / "o", progress=False),
    ])  # fmt: skip


def run(parameters, **folders):
    return running.run_notebooks(parameters, notebooks=SOURCES, progress=False, **folders)


API = [target, robot_name, plan_options, simulation, runner]


# ------------------------------------------------------------------------------------------ injected into a notebook


@cache
def source(path: Path):
    return load_notebook_node(str(path))


def injected(rng, folder):
    """Run a notebook as papermill would: add a cell after the parameters, then run up to the cell that checks them."""
    path = rng.choice(SOURCES)
    own = {"01": ("samples", [0, -5, 1.5, "200", True, 10**7]), "02": ("grid", [0, 1, "6", 6.0, None, 999]),
           "03": ("targets", [0, 201, "6", None, 2.5]), "04": ("targets", [0, 201, "6", None, 2.5]),
           "06": ("trials", [0, -1, "8", None, 2.5, 10**6]), "05": ("fast", [0, 1, "yes", None])}  # fmt: skip
    choices = [
        ("distance_m", [None, True, "1.0", "far", math.nan, -math.inf, 1e9, 3.2, [1.0], {}]),
        ("height_m", [None, False, "0.5", math.nan, 0.0, -0.3, 1.6, [0.5]]),
        ("robot", [None, 3, "", "asimo", "BHR", "a\0b", ["bhr"], f"{junk(rng)}?", "x" * 300]),
        (rng.choice(["out", "figures"]), [None, 3, "", True, ["x"], "a\0b"]),
        (rng.choice(["distance", "Distance_m", "height", "robotics", "n", "seed", "task", "plotting"]), [1, "x", None]),
    ]
    choices += [own[path.name[:2]]] * 2 if path.name[:2] in own else []
    name, values = rng.choice(choices)
    bad = rng.choice(values)

    def execute():
        given = parameterize_notebook(source(path), {name: bad}, report_mode=False)
        namespace = {"In": [""]}
        for cell in (c for c in given.cells if c.cell_type == "code"):
            namespace["In"].append(cell.source)
            exec(compile(cell.source, path.name, "exec"), namespace)
            if "check_parameters(" in cell.source:
                return

    return execute


# ------------------------------------------------------------------------------------------ the tests


def refuse(doors, count, seed, folder, monkeypatch, capfd):
    """Draw ``count`` cases; only one-line JumplabErrors, no file, no word on stderr, none slow."""
    rng, slowest, elsewhere = random.Random(seed), 0.0, folder / "here"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    checkout = tracked()
    for i in range(count):
        door = doors[i % len(doors)]
        case = folder / f"case{i}"
        case.mkdir()
        call = door(rng, case)
        before, began = sorted(p.name for p in case.rglob("*")), time.process_time()
        try:
            with matplotlib.rc_context():
                answer = call()
        except JumplabError as e:
            assert "\n" not in str(e) and 10 < len(str(e)) < 6000, (door.__name__, i, e)
        except Exception as e:
            raise AssertionError(f"{door.__name__}, case {i} of seed {seed}: {type(e).__name__}: {e}") from e
        else:
            raise AssertionError(f"{door.__name__}, case {i} of seed {seed}: accepted, gave {answer!r:.200}")
        slowest = max(slowest, time.process_time() - began)
        assert slowest < SLOWEST_S, (door.__name__, i)
        assert sorted(p.name for p in case.rglob("*")) == before, (door.__name__, i)
    assert os.listdir(elsewhere) == [] and tracked() == checkout
    assert capfd.readouterr() == ("", "")


def tracked() -> list[str]:
    """Content of the checkout itself, where a run without --out would write."""
    return sorted(p.name for p in ROOT.iterdir() if p.name != ".pytest_cache")


@pytest.mark.parametrize("door", API, ids=lambda d: d.__name__)
def test_api_refuses(door, tmp_path, monkeypatch, capfd):
    refuse([door], FEW if door is not runner else FEW // 12, 17, tmp_path, monkeypatch, capfd)


def test_notebooks_refuse(tmp_path, monkeypatch, capfd):
    refuse([injected], FEW, 19, tmp_path, monkeypatch, capfd)
