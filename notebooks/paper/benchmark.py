"""Cost of an iteration on ever finer meshes; plans from ever denser atlases; ever larger sweeps.

``python -m paper.benchmark`` in the folder of the notebooks measures the sweeps anew, in half an hour of two idle
cores, and writes :data:`SWEEPS`; notebook 10 draws that file. The one that is there was made with the five-link program
of the version before.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jumplab.auditing import audit
from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.show.style import COLUMN_IN, PURPLE, REFERENCE_STYLE, VERMILION, legend_above, new_figure
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import even
from jumplab.studies.atlas import Atlas
from jumplab.task import JumpTask
from paper import logs

NODES = (20, 40, 80)  # intervals of the three phases together
NODE_REPEATS = 3  # the growth is a fit over many meshes


def growth(
    robot: Robot, task: JumpTask, nodes: Sequence[int] = NODES, repeats: int = NODE_REPEATS
) -> list[dict[str, Any]]:
    """Cost of an iteration of the direct program on ever finer meshes: intervals, iterations, iteration_s."""
    body, rows = Body(robot), []
    for n in nodes:
        flat, toe = round(n / 3), round(4 * n / 15)
        mesh = Mesh(flat, toe, n - flat - toe)
        planner = WholeBodyPlanner(robot, mesh, body=body, free=even(body))
        plans = [planner.plan(task) for _ in range(repeats + 1)][1:]  # the first call of anything is not timed
        solves = [plan.attempts[0] for plan in plans]
        each = float(np.median([x.cpu_s / x.iterations for x in solves]))
        rows.append({"intervals": n, "iterations": solves[0].iterations, "iteration_s": each})
    return rows


def shares(plans: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Solver times [ms] of the last plan of a sort by its stages or starts, then the time of its tape and checks."""
    plan, out = plans[-1], {}
    for stage, took in plan["stages"]:
        first = stage.removeprefix("direct, ").partition(",")[0].removeprefix("3 ")
        out[first] = out.get(first, 0.0) + 1e3 * took
    return out | {"tape": 1e3 * (plan["plan_s"] - plan["solver_s"])}


FRESH = "new process"
KEPT = "new process, functions on file"
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
COLD = """
import time
began = time.perf_counter()
import json, sys
from pathlib import Path
from jumplab.stages.planner import Planner
from jumplab.robot import Robot
from jumplab.task import JumpTask
robot, task = Robot.load(sys.argv[1]), JumpTask(float(sys.argv[2]), float(sys.argv[3]))
plan = Planner(robot, keep=sys.argv[4] == "keep").plan(task)
plan_s, wall_s = time.process_time(), time.perf_counter() - began
solver_s, build_s = sum(x.cpu_s for x in plan.attempts), plan.statistics[0].build_s
iterations = sum(x.iterations for x in plan.attempts)
status = Path("/proc/self/status")  # of this process alone; what rusage says begins with the parent's peak
peak_gib = float(status.read_text().partition("VmHWM:")[2].split()[0]) / 2**20 if status.exists() else None
from jumplab.auditing.audit import audit
clean = audit(plan.tape, robot, task).passed
print(json.dumps(dict(solver_s=solver_s, plan_s=plan_s, wall_s=wall_s, build_s=build_s, iterations=iterations,
                      clean=clean, peak_gib=peak_gib)))
"""


def new_processes(robot: str, task: JumpTask, repeats: int) -> dict[str, list[dict[str, Any]]]:
    """Plans in new processes that build everything, and in others that find functions on file.

    All find Python's bytecode there.
    """
    out: dict[str, list[dict[str, Any]]] = {FRESH: [], KEPT: []}
    with TemporaryDirectory() as kept:
        environment = os.environ | ONE_THREAD | {"JUMPLAB_CACHE": kept, "PYTHONPYCACHEPREFIX": f"{kept}/bytecode"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        for k in range(repeats + 1):  # the first ones fill the folder
            for name, how in ((FRESH, "fresh"), (KEPT, "keep")):
                place = repr(task.distance_m), repr(task.height_m)
                command = [sys.executable, "-c", COLD, robot, *place, how]
                done = subprocess.run(command, capture_output=True, text=True, env=environment)
                if done.returncode:
                    last = done.stderr.strip().splitlines()[-1]
                    raise SolverError(f"the new process failed: {last}", stage="bench")
                if k:
                    out[name].append({"target": {}, **json.loads(done.stdout)})
    return out


AREA_M = (0.4, 0.2)  # distance and height around the target that every atlas spans
SPACINGS = (1, 2)  # intervals along each side
TARGETS = 6
TO_THE_END = {"acceptable_iter": 0, "tol": 1e-6}  # of ipopt, where the usual plan stops sooner


def density(
    robot: Robot, task: JumpTask, spacings: Sequence[int] = SPACINGS, targets: int = TARGETS
) -> list[dict[str, Any]]:
    """Plans from atlases of the same area and ever more nodes: their times, and their extra costs over the best.

    The best is what ipopt finds from there, to the end. ``iterations`` and ``cpu_ms`` are medians, the latter of a plan
    with its tape.
    """
    rng, body = np.random.default_rng(0), Body(robot)
    settled = WholeBodyPlanner(robot, body=body, free=even(body), options=TO_THE_END)
    low = max(task.distance_m - AREA_M[0] / 2, 0.0), max(task.height_m - AREA_M[1] / 2, 0.1)
    places = np.array(low) + rng.uniform(0.0, 1.0, (targets, 2)) * AREA_M
    rows = []
    for count in spacings:
        axes = [np.linspace(x, x + size, count + 1) for x, size in zip(low, AREA_M, strict=True)]
        atlas = Atlas.build(robot, *axes)
        planner, clean, took, steps, dearer = Planner(robot, atlas=atlas), 0, [], [], []
        planner.plan(JumpTask(*places[0]))  # the first call of anything is not timed
        for place in places:
            other, began = JumpTask(*place), process_time()
            plan = planner.plan(other)
            took.append(process_time() - began)
            steps.append(sum(row.iterations for row in plan.statistics))
            best = settled.plan(other, near=plan.whole_body).solution.statistics.objective
            dearer.append(plan.whole_body.solution.statistics.objective / best - 1)
            clean += audit(plan.tape, plan.robot, other).passed
        step = [round(size / count, 3) for size in AREA_M]
        row = {"nodes": len(atlas.nodes), "apart": f"{step[0]:g} x {step[1]:g}", "iterations": float(np.median(steps))}
        row |= {"cpu_ms": 1e3 * float(np.median(took))}
        row |= {"dearer": 100 * float(np.median(dearer)), "most": 100 * max(dearer), "clean": clean, "of": targets}
        rows.append(row)
    return rows


SWEEPS = Path(__file__).with_name("sweeps.json")
# plans -> how many distances, heights, masses, leg lengths; with one robot up to ten plans, with ten robots beyond
GRIDS = {1: (1, 1, 1, 1), 10: (5, 2, 1, 1), 100: (5, 2, 5, 2), 1000: (10, 10, 5, 2), 10_000: (40, 25, 5, 2)}
WAYS = ((1, False), (1, True), (2, True))  # processes, and whether an atlas is built first
LONGEST = {(1, False): 100, (1, True): 1000, (2, True): 10_000}  # plans that each way is asked for


def sweeps(counts: Sequence[int] = tuple(GRIDS)) -> list[dict[str, Any]]:
    """One ``jumplab sweep`` each, in processes of its own: plans, processes, atlas, clean ones, wall time, memory.

    Targets lie between 0.2 and 1.0 m far, 0.2 and 0.5 m high; robots differ by 5 % in masses and in lengths of the
    legs. With an atlas the motions are kept as well, at 50 Hz. ``peak_gib`` is the largest process' memory.
    """
    rows = []
    for count, (jobs, atlas) in ((count, way) for count in counts for way in WAYS):
        if count > LONGEST[jobs, atlas]:
            continue
        far, high, masses, legs = GRIDS[count]
        command = ["--distance-m", f"0.2:1.0:{far}" if far > 1 else "0.6", "--jobs", str(jobs)]
        command += ["--height-m", f"0.2:0.5:{high}" if high > 1 else "0.35"]
        command += ["--vary", f"mass=0.95:1.05:{masses}", "--vary", f"leg=0.95:1.05:{legs}"] * (masses > 1)
        command += ["--atlas", "--tapes", "50"] * atlas
        with TemporaryDirectory() as folder:
            began = perf_counter()
            command = [sys.executable, "-m", "jumplab", "sweep", "--json", *command, "--out", folder]
            child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            said = child.stdout.read()
            _, status, used = os.wait4(child.pid, 0)
            wall_s = perf_counter() - began
        if status:
            raise RuntimeError(f"{' '.join(command)}: {said}")
        found = json.loads(said)["rows"]
        row = {"plans": len(found), "robots": masses * legs, "processes": jobs, "atlas": atlas, "wall_s": wall_s}
        row |= {"clean": sum(r["clean"] for r in found), "peak_gib": used.ru_maxrss / 2**20}
        rows.append(row | {"cpu_s": used.ru_utime + used.ru_stime})
    return rows


def sweeps_picture(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Wall time of a plan, everything in it, over the number of plans."""
    fig = new_figure(COLUMN_IN, 2.2)
    ax, handles = fig.subplots(), []
    looks = dict(zip(WAYS, (dict(REFERENCE_STYLE), dict(color=PURPLE), dict(color=VERMILION)), strict=True))
    for (jobs, atlas), look in looks.items():
        ours = [r for r in rows if (r["processes"], r["atlas"]) == (jobs, atlas)]
        label = "each by itself" if not atlas else f"atlas, {jobs} process{'es' * (jobs > 1)}"
        count, wall = [r["plans"] for r in ours], [r["wall_s"] / r["plans"] for r in ours]
        handles += ax.plot(count, wall, marker="o", markersize=3, label=label, **look)
    ax.set(xscale="log", yscale="log", xlabel="plans in the sweep", ylabel="wall time per plan [s]")
    ticks = (0.2, 0.5, 1, 2, 5)
    ax.set(yticks=ticks, yticklabels=[f"{x:g}" for x in ticks])
    ax.minorticks_off()
    legend_above(fig, handles)
    return fig


if __name__ == "__main__":
    logs.write_table(SWEEPS, {"cpus": os.cpu_count(), "rows": sweeps()})
