"""How long a plan takes, against one direct NLP on the same machine in the same run.

What is compared: the three steps from nothing but the target; ``plan`` is the same to the end of the 1 kHz tape.
``direct`` is the solve of one NLP with the same model, limits, mesh, tolerances and derivatives, without stages 1 and
2, from a naive guess; of its two ways with ipopt alone, at once or over a coarse mesh, the faster one counts. Begun
with the Gauss-Newton steps that stage 3 begins with, it is faster still; that is timed too, and its ratio told. Times
are medians; every plan that was timed is audited afterwards.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from tempfile import TemporaryDirectory

import numpy as np

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.robot import Robot
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.planner import STEPS_S, JumpPlan, Planner, body_rows, guess_from_joints, make_tape
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.task import JumpTask

# report ------------------------------------------------------------------------------------------
# name -> (limit, aim); ratios of CPU times
GOALS = {
    "warm_over_direct": (0.6, 0.25),
    "replan_over_direct": (0.3, 0.1),
    "cold_over_direct": (1.5, None),
    "peak_memory_gib": (1.0, None),
    "node_growth_error": (0.2, None),
}
WORDS = {
    "warm_over_direct": "three steps, warm / direct NLP's solve",
    "replan_over_direct": "re-plan of a neighbouring target / direct NLP's solve",
    "cold_over_direct": "new process to finished plan / direct NLP's build and solve",
    "peak_memory_gib": "peak memory of a new process [GiB]",
    "node_growth_error": "cost of an iteration: largest distance from a straight line over the nodes",
}
FURTHER = {
    "tape_over_direct": "three steps and the 1 kHz tape, warm / direct NLP's solve",
    "warm_over_approached": "three steps, warm / direct NLP begun with stage 3's Gauss-Newton steps",
}
DIRECT = ("direct, at once", "direct, over a coarse mesh")  # by ipopt alone, from a cold start
APPROACHED = "direct, Gauss-Newton first"  # begun as stage 3 is
TAPE = "plan: tape"
PACKAGES = ("jumplab", "casadi", "pin", "proxsuite", "numpy")


def report(head: dict, cpu: dict, wall: dict, audits: dict, iterations: dict, functions: dict, growth: dict,
           peaks: list[float]) -> dict:  # fmt: skip
    """Put a benchmark's numbers together.

    Returns
    -------
    dict of plain types: the numbers of :data:`GOALS` (None if not measured), ``cold_kept_over_direct`` (as
    ``cold_over_direct``, but the new process found its functions on file), ``tape_over_direct`` (as
    ``warm_over_direct``, with the plan's 1 kHz tape, of which the direct solve has none), ``warm_over_approached`` (as
    ``warm_over_direct``, but the direct NLP is begun with Gauss-Newton steps too), ``goals`` (name -> value, limit,
    aim, reached), ``peer`` (by which way ipopt alone was faster), ``audits`` (name -> clean, of), ``median_s`` and
    ``raw_s`` (name -> CPU and wall times), ``iterations``, ``functions_s`` (CPU time of function evaluations in the
    solve on the fine mesh), ``where`` (stage -> share of the three steps' time), ``growth``, ``machine``.
    """
    peer = min(DIRECT, key=lambda name: np.median(cpu[name]))
    steps = np.sum([times for name, times in cpu.items() if name.startswith("plan: ") and name != TAPE], axis=0)
    numbers = {
        "warm_over_direct": _ratio(steps, cpu[peer]),
        "replan_over_direct": _ratio(cpu["re-plan"], cpu[peer]),
        "cold_over_direct": None,
        "peak_memory_gib": max(peaks) if peaks else None,
        "node_growth_error": line_error(growth["nodes"]),
    }
    whole = np.add(cpu["direct, build"], cpu[peer])
    if "cold" in cpu:
        numbers["cold_over_direct"] = _ratio(cpu["cold"], whole)
    goals = {}
    for name, (limit, aim) in GOALS.items():
        value = numbers[name]
        goals[name] = dict(value=value, limit=limit, aim=aim, reached=None if value is None else bool(value <= limit))
    stages = {name: float(np.median(times)) for name, times in cpu.items() if name.startswith("plan: ")}
    return {
        **numbers,
        "goals": goals,
        "peer": peer,
        "tape_over_direct": _ratio(cpu["plan"], cpu[peer]),
        "warm_over_approached": _ratio(steps, cpu[APPROACHED]),
        "cold_kept_over_direct": _ratio(cpu["cold, functions kept"], whole) if "cold" in cpu else None,
        "audits": {name: {"clean": sum(found), "of": len(found)} for name, found in audits.items()},
        **head,
        "median_s": {k: {n: float(np.median(x)) for n, x in v.items()} for k, v in (("cpu", cpu), ("wall", wall))},
        "where": {name: t / sum(stages.values()) for name, t in stages.items()},
        "iterations": iterations,
        "functions_s": functions,
        "growth": growth,
        "raw_s": {"cpu": cpu, "wall": wall},
        "machine": machine(),
    }


def _ratio(times, base) -> float:
    """Median over the repeats of the ratio within one repeat."""
    return float(np.median(np.divide(times, base)))


def line_error(rows: list[dict]) -> float | None:
    """Largest relative distance of an iteration's cost from the straight line through all meshes; None below three."""
    if len(rows) < 3:
        return None
    n, t = (np.array([row[key] for row in rows]) for key in ("intervals", "iteration_s"))
    line = np.polyval(np.polyfit(n, t, 1, w=1 / t), n)
    return float(np.max(np.abs(t / line - 1)))


def machine() -> dict:
    """What it ran on, and with which packages."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "(not installed)"
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"processor": platform.machine(), "system": platform.system(), "cpus": cpus, "load": load,
            "python": platform.python_version(), "versions": versions}  # fmt: skip


def text(found: dict) -> str:
    """The report for people."""
    lines = [
        f"direct NLP, the peer: {found['peer']} (ipopt from a cold start, the faster of two ways)",
        "",
        "ratios and limits",
    ]
    for name, goal in found["goals"].items():
        lines.append(f"  {WORDS[name]:<76} {_goal(goal)}")
    kept = found["cold_kept_over_direct"]
    if kept is not None:
        lines.append(f"  {'the same with functions kept from an earlier process':<76} {kept:.3f}")
    for key, words in FURTHER.items():
        lines.append(f"  {words:<76} {found[key]:.3f}")
    spread = found["growth"]["spread"]
    if spread:
        for key, peer in (("ratio", "direct NLP at once"), ("ratio_approached", APPROACHED)):
            ratios, words = [row[key] for row in spread], f"plan / {peer}, over {len(spread)} other targets"
            lines.append(f"  {words:<76} {np.median(ratios):.3f}  (median; {min(ratios):.2f} to {max(ratios):.2f}), "
                         f"{sum(row['clean'] for row in spread)} clean")  # fmt: skip
    lines += ["", f"medians of {found['repeats']} repeats [s]" + " " * 24 + "CPU      wall"]
    cpu, wall = found["median_s"]["cpu"], found["median_s"]["wall"]
    for name in cpu:
        lines.append(f"  {name:<38}{cpu[name]:>10.3f}{wall[name]:>10.3f}" if name in wall
                     else f"  {name:<38}{cpu[name]:>10.3f}")  # fmt: skip
    lines += ["", "iterations"]
    lines += [
        f"  {name}: " + ", ".join(f"{s} {n}" for s, n in row.items()) for name, row in found["iterations"].items()
    ]
    lines += ["", "growth of stage 3 with its mesh", "  intervals  iterations   solve [s]   per iteration [ms]"]
    lines += [f"  {r['intervals']:>9}{r['iterations']:>12}{r['solve_s']:>12.3f}{1e3 * r['iteration_s']:>14.2f}"
              for r in found["growth"]["nodes"]]  # fmt: skip
    targets = ", ".join(f"{n}: {t:.2f} s" for n, t in found["growth"]["targets_cpu_s"].items())
    lines += [f"  CPU time by number of targets: {targets}", "", _audits(found["audits"])]
    if not all(goal["reached"] for goal in found["goals"].values()):
        lines += ["", "where the time of the three steps goes"]
        lines += [f"  {name.removeprefix('plan: '):<16}{share:>6.0%}" for name, share in found["where"].items()]
        lines += [f"  of the solve on the fine mesh, {found['functions_s']['plan']:.3f} s of CPU time are function "
                  "evaluations, the rest is ipopt's and its linear solver's"]  # fmt: skip
    return "\n".join(lines)


def _goal(goal: dict) -> str:
    if goal["value"] is None:
        return "not measured"
    aim = f", aim {goal['aim']:g}" if goal["aim"] else ""
    word = "reached" if goal["reached"] else "not reached"
    return f"{goal['value']:.3f}  (limit {goal['limit']:g}{aim}): {word}"


def _audits(audits: dict) -> str:
    parts = [f"{name} {x['clean']} of {x['of']}" for name, x in audits.items()]
    return "plans that were timed and are clean in the audit: " + "; ".join(parts)


# measure ------------------------------------------------------------------------------------------
AT_ONCE, OVER_COARSE = DIRECT
WAYS = {AT_ONCE: {"refine": False}, OVER_COARSE: {"approach": False}, APPROACHED: {}}  # of solving the direct NLP
TASK, MESH = JumpTask(1.0, 0.5), Mesh()  # the paper's target, the usual mesh
NEIGHBOUR_M = 0.05  # our choice: how much farther the re-planned target is
NODES = (20, 40, 60, 80, 100, 120)  # intervals of the three phases together
TARGETS = (1, 2, 4, 8)
# our choice: shares of the target's distance and rise; how many iterations one target takes is a matter of luck
SPREAD = ((0.0, 0.8), (0.2, 0.6), (0.3, 1.0), (0.4, 0.4), (0.6, 1.0), (0.8, 0.6), (1.0, 0.6), (1.1, 0.8))
NODE_REPEATS = 3  # our choice: the growth is a fit over many meshes
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
COLD = """
import time
began = time.perf_counter()
import json, resource, sys
from jumplab.stages.planner import Planner
from jumplab.robot import Robot
from jumplab.task import JumpTask
robot, task = Robot.load(sys.argv[1]), JumpTask(float(sys.argv[2]), float(sys.argv[3]))
imports_s = time.process_time()
plan = Planner(robot, keep=sys.argv[4] == "keep").plan(task)
cpu_s, wall_s = time.process_time(), time.perf_counter() - began
peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
from jumplab.auditing.audit import audit
print(json.dumps(dict(cpu_s=cpu_s, wall_s=wall_s, imports_s=imports_s, peak_kib=peak_kib,
                      clean=audit(plan.tape, robot, task).passed)))
"""


class Stopwatch:
    """CPU and wall times [s] of named pieces of work, one number per repeat."""

    def __init__(self):
        self.cpu: dict[str, list[float]] = {}
        self.wall: dict[str, list[float]] = {}

    def __call__(self, name: str, work: Callable, *arguments, **options):
        """Do the work, and keep what it took."""
        cpu, wall = time.process_time(), time.perf_counter()
        answer = work(*arguments, **options)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        self.cpu.setdefault(name, []).append(cpu)
        self.wall.setdefault(name, []).append(wall)
        return answer


def bench(robot_name: str = "bhr", task: JumpTask = TASK, repeats: int = 7, mesh: Mesh = MESH,
          nodes: tuple[int, ...] = NODES, spread: tuple = SPREAD, cold: bool = True,
          say: Callable[[str], None] = print) -> dict:  # fmt: skip
    """Measure everything.

    Parameters
    ----------
    robot_name : shipped robot, or path of a TOML file.  task : the target.
    repeats : how often each thing is done; at least 1.
    mesh : of stage 3 and of the direct NLP; ``cold`` processes know only the default.
    nodes : numbers of intervals for the growth with nodes.
    spread : further targets, as shares of the target's distance and rise, planned once in both ways.
    cold : also time new processes.  say : is told what goes on.

    Returns
    -------
    dict of plain types, see :func:`jumplab.studies.bench.report`.

    Raises
    ------
    InputError
        For fewer repeats than 1.
    JumplabError
        If the target has no plan.
    """
    if repeats < 1:
        raise InputError(f"repeats = {repeats}: it takes 1 or more")
    robot, watch = Robot.load(robot_name), Stopwatch()
    planner = Planner(robot, mesh)
    ways = {name: WholeBodyPlanner(robot, mesh, tracking=False, **how).plan for name, how in WAYS.items()}
    audits: dict[str, list[bool]] = {}
    near = planner.plan(replace(task, distance_m=task.distance_m - NEIGHBOUR_M))
    for way in ways.values():
        way(near.task)  # the first call of anything is not timed
    peaks: list[float] = []
    with TemporaryDirectory() as kept:
        if cold:
            _cold(Stopwatch(), robot_name, task, {}, kept)  # fills the folder
        for k in range(repeats):
            say(f"repeat {k + 1} of {repeats}")
            plans = _once(watch, planner, ways, near, task)
            for name, plan in plans.items():
                audits.setdefault(name, []).append(audit(plan.tape, robot, task).passed)
            if cold:
                peaks.append(_cold(watch, robot_name, task, audits, kept))
    say("growth with nodes and targets")
    growth = {"nodes": _nodes(planner, task, nodes), "targets_cpu_s": _targets(planner, task),
              "spread": _spread(planner, ways, task, spread)}  # fmt: skip
    head = {"robot": robot.name, "target": vars(task), "mesh": mesh.intervals(), "repeats": repeats}
    iterations = {name: {r.stage: r.iterations for r in plan.statistics} for name, plan in plans.items()}
    functions = {name: plan.whole_body.solution.statistics.functions_s for name, plan in plans.items()}
    return report(head, watch.cpu, watch.wall, audits, iterations, functions, growth, peaks)


def _once(watch: Stopwatch, planner: Planner, ways: dict, near: JumpPlan, task: JumpTask) -> dict:
    """Time everything once, in turn; returns the plans."""
    robot = planner.robot
    _stages(watch, planner, task)
    bodies = {name: watch(name, way, task) for name, way in ways.items()}
    plans = {"plan": watch("plan", planner.plan, task), "re-plan": watch("re-plan", planner.replan, near, task)}
    watch("direct, build", lambda: WholeBodyPlanner(robot, planner.mesh, tracking=False, refine=False).nlp.prepare())
    for name, body in bodies.items():
        rows = body_rows("direct", body)
        plans[name] = JumpPlan(task, robot, "direct", make_tape(body, robot), None, None, body, rows)
    return plans


def _stages(watch: Stopwatch, planner: Planner, task: JumpTask) -> None:
    """The three steps once more, each timed apart."""
    robot, last = planner.robot, planner.stage("whole body")
    srmp = watch("plan: 1 SRMP", planner.stage("srmp").plan, task)
    joints = watch("plan: 2 joint map", map_to_joints, srmp, robot, STEPS_S, "direct")
    guess = watch("plan: 2 to 3", guess_from_joints, joints, last, task, srmp.toe_s)
    body = watch("plan: 3 whole body", last.plan, task, srmp, guess=guess)
    watch("plan: tape", make_tape, body, robot, srmp)


def _cold(watch: Stopwatch, robot_name: str, task: JumpTask, audits: dict, kept: str) -> float:
    """One plan in a new process that builds everything, and one in another that finds the functions of an earlier one
    in the folder ``kept``; returns the peak memory of the first [GiB]. Python's own bytecode is on file for both, as it
    is after any first run, whatever the settings of this process."""
    peak = 0.0
    environment = os.environ | ONE_THREAD | {"JUMPLAB_CACHE": kept, "PYTHONPYCACHEPREFIX": f"{kept}/bytecode"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    for name, how in (("cold", "fresh"), ("cold, functions kept", "keep")):
        command = [sys.executable, "-c", COLD, robot_name, repr(task.distance_m), repr(task.height_m), how]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise SolverError(f"the new process failed: {done.stderr.strip().splitlines()[-1]}", stage="cold")
        said = json.loads(done.stdout)
        for key, number in ((name, "cpu_s"), (f"{name}: imports and robot", "imports_s")):
            watch.cpu.setdefault(key, []).append(said[number])
        watch.wall.setdefault(name, []).append(said["wall_s"])
        audits.setdefault(name, []).append(said["clean"])
        peak = max(peak, said["peak_kib"] / 2**20)
    return peak


def _nodes(planner: Planner, task: JumpTask, nodes) -> list[dict]:
    """Cost of one iteration of stage 3 on ever finer meshes, all solved at once from stage 2's guess."""
    srmp = planner.stage("srmp").plan(task)
    joints = map_to_joints(srmp, planner.robot, STEPS_S, "direct")
    rows = []
    for n in nodes:
        flat, toe = max(round(n / 3), 2), max(round(4 * n / 15), 2)
        mesh = Mesh(flat, toe, max(n - flat - toe, 2))
        watch = Stopwatch()
        body = watch("build", WholeBodyPlanner, planner.robot, mesh, refine=False)
        guess = guess_from_joints(joints, body, task, srmp.toe_s)
        for _ in range(NODE_REPEATS):
            s = watch("solve", body.plan, task, srmp, guess=guess).solution.statistics
        solve_s = float(np.median(watch.cpu["solve"]))
        rows.append(dict(intervals=mesh.flat + mesh.toe + mesh.flight, variables=s.variables,
                         iterations=s.iterations, build_s=watch.cpu["build"][0], solve_s=solve_s,
                         iteration_s=solve_s / s.iterations))  # fmt: skip
    return rows


def _spread(planner: Planner, ways: dict, task: JumpTask, spread) -> list[dict]:
    """Other targets, each planned once by three steps and directly, by ipopt at once and begun with Gauss-Newton steps:
    CPU times [s], and the ratios; those without a plan are left out.

    The peers' times are those of their solves alone, as everywhere.
    """
    rows = []
    for distance, height in spread:
        other, watch = (
            replace(task, distance_m=distance * task.distance_m, height_m=height * task.height_m),
            Stopwatch(),
        )
        try:
            plan = watch("plan", planner.plan, other)
            for name in (AT_ONCE, APPROACHED):
                watch(name, ways[name], other)
        except JumplabError:
            continue
        plan_s, direct_s, begun_s = (watch.cpu[name][0] for name in ("plan", AT_ONCE, APPROACHED))
        clean = audit(plan.tape, planner.robot, other).passed
        rows.append(dict(distance_m=other.distance_m, height_m=other.height_m, plan_s=plan_s, direct_s=direct_s,
                         ratio=plan_s / direct_s, approached_s=begun_s, ratio_approached=plan_s / begun_s,
                         clean=clean))  # fmt: skip
    return rows


def _targets(planner: Planner, task: JumpTask) -> dict[str, float]:
    """CPU time [s] of planning so many different targets with one planner."""
    watch = Stopwatch()
    for k in range(TARGETS[-1]):
        watch("plan", planner.plan, replace(task, distance_m=task.distance_m - 0.02 * k))
    return {str(n): sum(watch.cpu["plan"][:n]) for n in TARGETS}
