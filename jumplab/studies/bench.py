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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import numpy as np

from jumplab.auditing.audit import audit
from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.io.folder import versions
from jumplab.robot import Robot
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.planner import STEPS_S, JumpPlan, Planner, body_rows, guess_from_joints, make_tape
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.task import JumpTask

# name -> (words, limit, aim); ratios of CPU times
GOALS = {
    "warm_over_direct": ("three steps, warm / direct NLP's solve", 0.6, 0.25),
    "replan_over_direct": ("re-plan of a neighbouring target / direct NLP's solve", 0.3, 0.1),
    "cold_over_direct": ("new process to finished plan / direct NLP's build and solve", 1.5, None),
    "peak_memory_gib": ("peak memory of a new process [GiB]", 1.0, None),
    "node_growth_error": ("cost of an iteration: largest distance from a straight line over the nodes", 0.2, None),
}
AT_ONCE, OVER_COARSE, APPROACHED = "direct, at once", "direct, over a coarse mesh", "direct, Gauss-Newton first"
DIRECT = (AT_ONCE, OVER_COARSE)  # by ipopt alone, from a cold start
WAYS = {AT_ONCE: {"refine": False}, OVER_COARSE: {"approach": False}, APPROACHED: {}}  # of solving the direct NLP
TAPE = "plan: tape"


def report(
    head: Mapping[str, Any], watch: Stopwatch, audits: Mapping[str, list[bool]], growth: Mapping, peaks: list[float]
) -> dict[str, Any]:
    """Put a benchmark's numbers together.

    Returns
    -------
    dict of plain types: ``head``; the numbers of :data:`GOALS` (None if not measured), ``cold_kept_over_direct`` (as
    ``cold_over_direct``, but the new process found its functions on file), ``tape_over_direct`` (as
    ``warm_over_direct``, with the plan's 1 kHz tape, of which the direct solve has none), ``warm_over_approached`` (as
    ``warm_over_direct``, but the direct NLP is begun with Gauss-Newton steps too), ``goals`` (name -> value, limit,
    aim, reached), ``peer`` (by which way ipopt alone was faster), ``audits`` (name -> clean, of), ``median_s`` and
    ``raw_s`` (name -> CPU and wall times), ``where`` (stage -> share of the three steps' time), ``growth``,
    ``machine`` (what it ran on, and with which packages).
    """
    cpu, known = watch.cpu, versions()
    peer = min(DIRECT, key=lambda name: np.median(cpu[name]))
    steps = np.sum([times for name, times in cpu.items() if name.startswith("plan: ") and name != TAPE], axis=0)
    whole = np.add(cpu["direct, build"], cpu[peer])
    raw = {"cpu": cpu, "wall": watch.wall}
    medians = {kind: {n: float(np.median(x)) for n, x in times.items()} for kind, times in raw.items()}
    stages = {name: t for name, t in medians["cpu"].items() if name.startswith("plan: ")}
    numbers = {
        "warm_over_direct": _ratio(steps, cpu[peer]),
        "replan_over_direct": _ratio(cpu["re-plan"], cpu[peer]),
        "cold_over_direct": _ratio(cpu["cold"], whole) if "cold" in cpu else None,
        "peak_memory_gib": max(peaks, default=None),
        "node_growth_error": line_error(growth["nodes"]),
    }
    goals = {}
    for (name, value), (_, limit, aim) in zip(numbers.items(), GOALS.values(), strict=True):
        goals[name] = dict(value=value, limit=limit, aim=aim, reached=None if value is None else bool(value <= limit))
    return {
        **numbers,
        "goals": goals,
        "peer": peer,
        "tape_over_direct": _ratio(cpu["plan"], cpu[peer]),
        "warm_over_approached": _ratio(steps, cpu[APPROACHED]),
        "cold_kept_over_direct": _ratio(cpu["cold, functions kept"], whole) if "cold" in cpu else None,
        "audits": {name: {"clean": sum(found), "of": len(found)} for name, found in audits.items()},
        **head,
        "median_s": medians,
        "where": {name: t / sum(stages.values()) for name, t in stages.items()},
        "growth": growth,
        "raw_s": raw,
        "machine": {
            "processor": platform.machine(),
            "system": platform.system(),
            "cpus": joblib.cpu_count(),
            "load": os.getloadavg()[0],
            "python": known["python"],
            "versions": {name: known[name] for name in ("jumplab", "casadi", "pin", "proxsuite", "numpy")},
        },
    }


def _ratio(times: Sequence[float], base: Sequence[float]) -> float:
    """Median over the repeats of the ratio within one repeat."""
    return float(np.median(np.divide(times, base)))


def line_error(rows: list[dict[str, float]]) -> float | None:
    """Largest relative distance of an iteration's cost from the straight line through all meshes; None below three."""
    if len(rows) < 3:
        return None
    n, t = (np.array([row[key] for row in rows]) for key in ("intervals", "iteration_s"))
    line = np.polyval(np.polyfit(n, t, 1, w=1 / t), n)
    return float(np.max(np.abs(t / line - 1)))


def text(found: Mapping[str, Any]) -> str:
    """The report for people."""
    lines = [f"direct NLP, the peer: {found['peer']} (ipopt from a cold start, the faster of two ways)", ""]
    ratios = [(GOALS[name][0], _goal(goal)) for name, goal in found["goals"].items()]
    if found["cold_kept_over_direct"] is not None:
        ratios += [("the same with functions kept from an earlier process", f"{found['cold_kept_over_direct']:.3f}")]
    begun = "three steps, warm / direct NLP begun with stage 3's Gauss-Newton steps"
    ratios += [("three steps and the 1 kHz tape, warm / direct NLP's solve", f"{found['tape_over_direct']:.3f}")]
    ratios += [(begun, f"{found['warm_over_approached']:.3f}")]
    spread = found["growth"]["spread"]
    for key, peer in (("ratio", "direct NLP at once"), ("ratio_approached", APPROACHED)) if spread else ():
        values = [row[key] for row in spread]
        said = f"{np.median(values):.3f}  (median; {min(values):.2f} to {max(values):.2f})"
        clean = f"{sum(row['clean'] for row in spread)} clean"
        ratios += [(f"plan / {peer}, over {len(spread)} other targets", f"{said}, {clean}")]
    lines += ["ratios and limits", *(f"  {words:<76} {said}" for words, said in ratios)]
    lines += ["", f"medians of {found['repeats']} repeats [s]" + " " * 24 + "CPU      wall"]
    wall = {name: f"{t:>10.3f}" for name, t in found["median_s"]["wall"].items()}
    lines += [f"  {name:<38}{t:>10.3f}{wall.get(name, '')}" for name, t in found["median_s"]["cpu"].items()]
    lines += ["", "iterations"]
    for name, row in found["iterations"].items():
        lines.append(f"  {name}: " + ", ".join(f"{stage} {n}" for stage, n in row.items()))
    lines += ["", "growth of stage 3 with its mesh", "  intervals  iterations   solve [s]   per iteration [ms]"]
    for r in found["growth"]["nodes"]:
        n, count, solve_s, each_s = (r[key] for key in ("intervals", "iterations", "solve_s", "iteration_s"))
        lines.append(f"  {n:>9}{count:>12}{solve_s:>12.3f}{1e3 * each_s:>14.2f}")
    targets = ", ".join(f"{n}: {t:.2f} s" for n, t in found["growth"]["targets_cpu_s"].items())
    audits = "; ".join(f"{name} {x['clean']} of {x['of']}" for name, x in found["audits"].items())
    timed = f"plans that were timed and are clean in the audit: {audits}"
    lines += [f"  CPU time by number of targets: {targets}", "", timed]
    if not all(goal["reached"] for goal in found["goals"].values()):
        lines += ["", "where the time of the three steps goes"]
        lines += [f"  {name.removeprefix('plan: '):<16}{share:>6.0%}" for name, share in found["where"].items()]
        own = f"{found['functions_s']['plan']:.3f} s of CPU time are function evaluations"
        lines += [f"  of the solve on the fine mesh, {own}, the rest is ipopt's and its linear solver's"]
    return "\n".join(lines)


def _goal(goal: Mapping[str, Any]) -> str:
    if goal["value"] is None:
        return "not measured"
    aim = f", aim {goal['aim']:g}" if goal["aim"] else ""
    return f"{goal['value']:.3f}  (limit {goal['limit']:g}{aim}): {'reached' if goal['reached'] else 'not reached'}"


# measure ------------------------------------------------------------------------------------------
TASK, MESH = JumpTask(1.0, 0.5), Mesh()  # the paper's target, the usual mesh
NEIGHBOUR_M = 0.05  # how much farther the re-planned target is
NODES = (20, 40, 60, 80, 100, 120)  # intervals of the three phases together
NODE_REPEATS = 3  # the growth is a fit over many meshes
TARGETS = (1, 2, 4, 8)
# shares of the target's distance and rise; how many iterations one target takes is a matter of luck
SPREAD = ((0.0, 0.8), (0.2, 0.6), (0.3, 1.0), (0.4, 0.4), (0.6, 1.0), (0.8, 0.6), (1.0, 0.6), (1.1, 0.8))
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
        self.keep(name, time.process_time() - cpu, time.perf_counter() - wall)
        return answer

    def keep(self, name: str, cpu_s: float, wall_s: float | None = None) -> None:
        """Keep what a piece of work took."""
        self.cpu.setdefault(name, []).append(cpu_s)
        if wall_s is not None:
            self.wall.setdefault(name, []).append(wall_s)


def bench(
    robot_name: str = "bhr",
    task: JumpTask = TASK,
    repeats: int = 7,
    mesh: Mesh = MESH,
    nodes: Sequence[int] = NODES,
    spread: Sequence[tuple[float, float]] = SPREAD,
    cold: bool = True,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Measure everything; returns plain types, see :func:`report`.

    Raises :class:`InputError` for fewer repeats than 1, another :class:`JumplabError` if the target has no plan.

    Parameters
    ----------
    robot_name : shipped robot, or path of a TOML file.  task : the target.
    repeats : how often each thing is done; at least 1.
    mesh : of stage 3 and of the direct NLP; ``cold`` processes know only the default.
    nodes : numbers of intervals for the growth with nodes.
    spread : further targets, as shares of the target's distance and rise, planned once in both ways.
    cold : also time new processes.  say : is told what goes on.
    """
    if repeats < 1:
        raise InputError(f"repeats = {repeats}: it takes 1 or more")
    robot, watch = Robot.load(robot_name), Stopwatch()
    planner = Planner(robot, mesh=mesh)
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
    growth = {"nodes": _nodes(planner, task, nodes), "targets_cpu_s": _targets(planner, task)}
    growth["spread"] = _spread(planner, ways, task, spread)
    head = {"robot": robot.name, "target": vars(task), "mesh": mesh.intervals(), "repeats": repeats}
    head["iterations"] = {name: {r.stage: r.iterations for r in plan.statistics} for name, plan in plans.items()}
    # CPU time of function evaluations in the solve on the fine mesh
    head["functions_s"] = {name: plan.whole_body.solution.statistics.functions_s for name, plan in plans.items()}
    return report(head, watch, audits, growth, peaks)


def _once(
    watch: Stopwatch, planner: Planner, ways: Mapping[str, Callable], near: JumpPlan, task: JumpTask
) -> dict[str, JumpPlan]:
    """Time everything once, in turn; returns the plans."""
    robot, last = planner.robot, planner.stage("whole body")
    srmp = watch("plan: 1 SRMP", planner.stage("srmp").plan, task)
    joints = watch("plan: 2 joint map", map_to_joints, srmp, robot, STEPS_S, "direct")
    guess = watch("plan: 2 to 3", guess_from_joints, joints, last, task, srmp.toe_s)
    body = watch("plan: 3 whole body", last.plan, task, srmp, guess=guess)
    watch(TAPE, make_tape, body, robot, srmp)
    bodies = {name: watch(name, way, task) for name, way in ways.items()}
    plans = {"plan": watch("plan", planner.plan, task), "re-plan": watch("re-plan", planner.replan, near, task)}
    watch("direct, build", lambda: WholeBodyPlanner(robot, planner.mesh, tracking=False, refine=False).nlp.prepare())
    for name, body in bodies.items():
        rows = body_rows("direct", body)
        plans[name] = JumpPlan(task, robot, "direct", make_tape(body, robot), None, None, body, rows)
    return plans


def _cold(watch: Stopwatch, robot_name: str, task: JumpTask, audits: dict[str, list[bool]], kept: str) -> float:
    """One plan in a new process that builds everything, and one in another that finds the functions of an earlier one
    in the folder ``kept``; returns the larger peak of memory [GiB]. Python's own bytecode is on file for both, as it is
    after any first run."""
    peak = 0.0
    environment = os.environ | ONE_THREAD | {"JUMPLAB_CACHE": kept, "PYTHONPYCACHEPREFIX": f"{kept}/bytecode"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    for name, how in (("cold", "fresh"), ("cold, functions kept", "keep")):
        command = [sys.executable, "-c", COLD, robot_name, repr(task.distance_m), repr(task.height_m), how]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode:
            raise SolverError(f"the new process failed: {done.stderr.strip().splitlines()[-1]}", stage="cold")
        said = json.loads(done.stdout)
        watch.keep(name, said["cpu_s"], said["wall_s"])
        watch.keep(f"{name}: imports and robot", said["imports_s"])
        audits.setdefault(name, []).append(said["clean"])
        peak = max(peak, said["peak_kib"] / 2**20)
    return peak


def _nodes(planner: Planner, task: JumpTask, nodes: Sequence[int]) -> list[dict[str, float]]:
    """Cost of one iteration of stage 3 on ever finer meshes, all solved at once from stage 2's guess."""
    srmp = planner.stage("srmp").plan(task)
    joints = map_to_joints(srmp, planner.robot, STEPS_S, "direct")
    rows = []
    for n in nodes:
        flat, toe = max(round(n / 3), 2), max(round(4 * n / 15), 2)
        mesh, watch = Mesh(flat, toe, max(n - flat - toe, 2)), Stopwatch()
        body = watch("build", WholeBodyPlanner, planner.robot, mesh, refine=False)
        guess = guess_from_joints(joints, body, task, srmp.toe_s)
        for _ in range(NODE_REPEATS):
            s = watch("solve", body.plan, task, srmp, guess=guess).solution.statistics
        row = {"intervals": sum(mesh.intervals().values()), "variables": s.variables, "iterations": s.iterations}
        solve_s = float(np.median(watch.cpu["solve"]))
        rows.append(row | dict(build_s=watch.cpu["build"][0], solve_s=solve_s, iteration_s=solve_s / s.iterations))
    return rows


def _spread(
    planner: Planner, ways: Mapping[str, Callable], task: JumpTask, spread: Sequence[tuple[float, float]]
) -> list[dict[str, Any]]:
    """Other targets, each planned once by three steps and directly, by ipopt at once and begun with Gauss-Newton steps:
    CPU times [s] (the peers' of their solves alone, as everywhere), and the ratios; not those without a plan."""
    rows = []
    for distance, height in spread:
        place = {"distance_m": distance * task.distance_m, "height_m": height * task.height_m}
        other, watch = replace(task, **place), Stopwatch()
        try:
            plan = watch("plan", planner.plan, other)
            for name in (AT_ONCE, APPROACHED):
                watch(name, ways[name], other)
        except JumplabError:
            continue
        plan_s, direct_s, begun_s = (watch.cpu[name][0] for name in ("plan", AT_ONCE, APPROACHED))
        times = {"plan_s": plan_s, "direct_s": direct_s, "ratio": plan_s / direct_s}
        times |= {"approached_s": begun_s, "ratio_approached": plan_s / begun_s}
        rows.append(place | times | {"clean": audit(plan.tape, planner.robot, other).passed})
    return rows


def _targets(planner: Planner, task: JumpTask) -> dict[str, float]:
    """CPU time [s] of planning so many different targets with one planner."""
    watch = Stopwatch()
    for k in range(TARGETS[-1]):
        watch("plan", planner.plan, replace(task, distance_m=task.distance_m - 0.02 * k))
    return {str(n): sum(watch.cpu["plan"][:n]) for n in TARGETS}
