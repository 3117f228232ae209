"""How long a plan takes, against one direct NLP on the same machine in the same run.

What is compared: the three steps from nothing but the target; ``plan`` is the same to the end of the 1 kHz tape.
``direct`` is the solve of one NLP with the same model, limits, mesh, tolerances and derivatives, without stages 1 and
2, with the exact Hessian. With the held Gauss-Newton Hessian it is faster, and the usual method; that is timed too, and
its ratio told. Re-plans and new processes are those of the usual method. Times are medians; every plan that was timed
is audited afterwards.
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
from jumplab.stages.planner import STEPS_S, JumpPlan, Planner, body_rows, make_tape, motion_of_joints
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner
from jumplab.stages.whole_body.coordinates import even
from jumplab.stages.whole_body.planner import IN_PLANE
from jumplab.stages.whole_body.terms import Body
from jumplab.studies.atlas import Atlas
from jumplab.task import JumpTask

AT_ONCE, HELD = "direct, exact Hessian", "direct, held Gauss-Newton first"
WAYS = {AT_ONCE: IN_PLANE[1:], HELD: IN_PLANE}  # lists of starts of the direct NLP
TAPE = "plan: tape"
ATLAS, AUDITED = "atlas", "atlas, with tape and audit"
SHORT = 5  # times on end that what takes less than 0.1 s is done
SPAN_M = (0.15, 0.075)  # half of an atlas' cell around the target: distance, height


def report(
    head: Mapping[str, Any], watch: Stopwatch, audits: Mapping[str, list[bool]], growth: Mapping, peaks: list[float]
) -> dict[str, Any]:
    """Put a benchmark's numbers together.

    Returns
    -------
    dict of plain types: ``head``; ratios of CPU times, None if not measured: three steps (``warm``), plan with its tape
    (``tape``), re-plan, and new process (``cold``, ``cold_kept`` with functions on file; over build and solve) over the
    direct solve, three steps over the held one (``three_over_direct_gn``), a plan from an atlas over the direct
    solve (``atlas_over_direct``); ``process_s``, wall time of a new process with functions on file, from its start to
    the audit's end; ``plans_per_s``, audited plans from an atlas by one core; ``node_growth_error``, see
    :func:`line_error`;
    ``peak_memory_gib``; ``audits`` (name -> clean, of), ``median_s``
    and ``raw_s`` (CPU and wall times), ``where`` (stage -> share of a plan's time), ``growth``, ``machine``.
    """
    cpu, known = watch.cpu, versions()
    peer = AT_ONCE
    steps = np.sum([times for name, times in cpu.items() if name.startswith("plan: ") and name != TAPE], axis=0)
    whole = np.add(cpu["direct, build"], cpu[peer])
    raw = {"cpu": cpu, "wall": watch.wall}
    medians = {kind: {n: float(np.median(x)) for n, x in times.items()} for kind, times in raw.items()}
    stages = {name: t for name, t in medians["cpu"].items() if name.startswith("plan: ")}
    packages = {name: known[name] for name in ("jumplab", "casadi", "pin", "proxsuite", "numpy")}
    machine = {"processor": platform.machine(), "system": platform.system(), "cpus": joblib.cpu_count()}
    machine |= {"load": os.getloadavg()[0], "python": known["python"], "versions": packages}
    return {
        "warm_over_direct": _ratio(steps, cpu[peer]),
        "replan_over_direct": _ratio(cpu["re-plan"], cpu[peer]),
        "cold_over_direct": _ratio(cpu.get("cold"), whole),
        "peak_memory_gib": max(peaks, default=None),
        "node_growth_error": line_error(growth["nodes"]),
        "tape_over_direct": _ratio(cpu["plan"], cpu[peer]),
        "cold_kept_over_direct": _ratio(cpu.get("cold, functions kept"), whole),
        "three_over_direct_gn": _ratio(steps, cpu[HELD]),
        "atlas_over_direct": _ratio(cpu.get(ATLAS), cpu[peer]),
        "process_s": medians["wall"].get("process"),
        "plans_per_s": 1 / medians["cpu"][AUDITED] if AUDITED in cpu else None,
        "audits": {name: {"clean": sum(found), "of": len(found)} for name, found in audits.items()},
        **head,
        "median_s": medians,
        "where": {name: t / sum(stages.values()) for name, t in stages.items()},
        "growth": growth,
        "raw_s": raw,
        "machine": machine,
    }


def _ratio(times: Sequence[float] | None, base: Sequence[float]) -> float | None:
    """Median over the repeats of the ratio within one repeat."""
    return None if times is None else float(np.median(np.divide(times, base)))


def line_error(rows: list[dict[str, float]]) -> float | None:
    """Largest relative distance of an iteration's cost from the straight line through all meshes; None below three."""
    if len(rows) < 3:
        return None
    n, t = (np.array([row[key] for row in rows]) for key in ("intervals", "iteration_s"))
    line = np.polyval(np.polyfit(n, t, 1, w=1 / t), n)
    return float(np.max(np.abs(t / line - 1)))


def rows(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A short table of a :func:`report`: median CPU time of each piece [s], and its ratio to the direct NLP's."""
    cpu = found["median_s"]["cpu"]
    steps_s = sum(t for name, t in cpu.items() if name.startswith("plan: ") and name != TAPE)
    ratios = {"three steps": "warm", "plan": "tape", "re-plan": "replan", "cold": "cold"}
    ratios = {name: found[f"{key}_over_direct"] for name, key in ratios.items()} | {ATLAS: found["atlas_over_direct"]}
    ratios |= {"cold, functions kept": found["cold_kept_over_direct"], AT_ONCE: 1.0}
    return [{"what": n, "CPU [s]": t, "ratio": ratios.get(n)} for n, t in {"three steps": steps_s, **cpu}.items()]


TASK, MESH = JumpTask(1.0, 0.5), Mesh()  # the paper's target, the usual mesh
NEIGHBOUR_M = 0.05  # how much farther the re-planned target is
NODES = (20, 40, 60, 80, 100, 120)  # intervals of the three phases together
NODE_REPEATS = 3  # the growth is a fit over many meshes
TARGETS = (1, 2, 4, 8)  # numbers of targets for the growth with targets
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

    def __call__(self, name: str, work: Callable, *arguments, times: int = 1, **options):
        """Do the work, ``times`` on end what is short, and keep what it took, the median of those."""
        took = []
        for _ in range(times):
            cpu, wall = time.process_time(), time.perf_counter()
            answer = work(*arguments, **options)
            took.append((time.process_time() - cpu, time.perf_counter() - wall))
        self.keep(name, *np.median(took, axis=0).tolist())
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
    """Measure everything ``repeats`` times; returns plain types, see :func:`report`.

    ``mesh`` is that of stage 3 and of the direct NLP (new processes, timed if ``cold``, know only the default),
    ``nodes`` are numbers of intervals for the growth with nodes, ``spread`` further targets, as shares of the target's
    distance and rise; ``say`` is told what goes on. Raises :class:`InputError` for fewer repeats than 1, another
    :class:`JumplabError` if the target has no plan.
    """
    if repeats < 1:
        raise InputError(f"repeats = {repeats}: it takes 1 or more")
    robot, watch = Robot.load(robot_name), Stopwatch()
    planner, atlas = Planner(robot, mesh=mesh), _atlas(robot, mesh, task)
    body = Body(robot)
    how = {"body": body, "free": even(body)}
    ways = {name: WholeBodyPlanner(robot, mesh, starts=starts, **how).plan for name, starts in WAYS.items()}
    audits: dict[str, list[bool]] = {}
    near = planner.plan(replace(task, distance_m=task.distance_m - NEIGHBOUR_M))
    planner.plan(near.task, "three-step")  # the first call of anything is not timed
    for way in ways.values():
        way(near.task)
    peaks: list[float] = []
    with TemporaryDirectory() as kept:
        if cold:
            _cold(Stopwatch(), robot_name, task, {}, kept)  # fills the folder
        for k in range(repeats):
            say(f"repeat {k + 1} of {repeats}")
            plans = _once(watch, planner, ways, near, task, atlas)
            for name, plan in plans.items():
                audits.setdefault(name, []).append(audit(plan.tape, robot, task).passed)
            if cold:
                peaks.append(_cold(watch, robot_name, task, audits, kept))
    say("growth with nodes and targets")
    each = Stopwatch()
    for k in range(TARGETS[-1]):  # different targets with one planner
        each("plan", planner.plan, replace(task, distance_m=task.distance_m - 0.02 * k))
    growth = {"nodes": _nodes(planner, task, nodes), "spread": _spread(planner, ways, task, spread)}
    growth["targets_cpu_s"] = {str(n): sum(each.cpu["plan"][:n]) for n in TARGETS}
    head = {"robot": robot.name, "target": vars(task), "mesh": mesh.intervals(), "repeats": repeats}
    head["iterations"] = {name: {r.stage: r.iterations for r in plan.statistics} for name, plan in plans.items()}
    # CPU time of function evaluations in the solve on the fine mesh
    head["functions_s"] = {name: plan.whole_body.solution.statistics.functions_s for name, plan in plans.items()}
    return report(head, watch, audits, growth, peaks)


def _once(
    watch: Stopwatch, planner: Planner, ways: Mapping[str, Callable], near: JumpPlan, task: JumpTask, atlas: Planner
) -> dict[str, JumpPlan]:
    """Time everything once, in turn; returns the plans."""
    robot, last = planner.robot, planner.stage("whole body")
    srmp = watch("plan: 1 SRMP", planner.stage("srmp").plan, task)
    joints = watch("plan: 2 joint map", map_to_joints, srmp, robot, STEPS_S, "direct")
    begin = watch("plan: 2 to 3", motion_of_joints, joints, last, srmp.toe_s)
    body = watch("plan: 3 whole body", last.plan, task, srmp, begin=begin)
    watch(TAPE, make_tape, body, srmp)
    bodies = {name: watch(name, way, task) for name, way in ways.items()}
    plans = {
        "plan": watch("plan", planner.plan, task, "three-step"),
        "re-plan": watch("re-plan", planner.replan, near, task, times=SHORT),
    }
    answered = watch(ATLAS, atlas.atlas.solve, atlas.stage("direct"), task, times=SHORT)
    watch(AUDITED, lambda: audit(atlas.plan(task).tape, atlas.robot, task), times=SHORT)
    watch("direct, build", lambda: WholeBodyPlanner(robot, planner.mesh, free=even(last.body)).nlp.prepare())
    for name, body in {**bodies, **({ATLAS: answered} if answered else {})}.items():
        rows = body_rows("direct", body, 0.0)
        plans[name] = JumpPlan(task, robot, "direct", make_tape(body), None, None, body, rows)
    return plans


def _atlas(robot: Robot, mesh: Mesh, task: JumpTask) -> Planner:
    """A planner with an atlas of four nodes around the target."""
    (d, h), (wide, high) = (task.distance_m, task.height_m), SPAN_M
    atlas = Atlas.build(robot, (d - wide, d + wide), (max(h - high, 0.05), h + high), mesh=mesh)
    planner = Planner(robot, mesh=mesh, atlas=atlas)
    planner.plan(task)  # the first call of anything is not timed
    return planner


def _cold(watch: Stopwatch, robot_name: str, task: JumpTask, audits: dict[str, list[bool]], kept: str) -> float:
    """One plan in a new process that builds everything, one in another that finds functions on file in ``kept``; both
    find Python's bytecode there. Returns the larger peak of memory [GiB]."""
    peak = 0.0
    environment = os.environ | ONE_THREAD | {"JUMPLAB_CACHE": kept, "PYTHONPYCACHEPREFIX": f"{kept}/bytecode"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    for name, how in (("cold", "fresh"), ("cold, functions kept", "keep")):
        command = [sys.executable, "-c", COLD, robot_name, repr(task.distance_m), repr(task.height_m), how]
        began = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if how == "keep":
            watch.wall.setdefault("process", []).append(time.perf_counter() - began)
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
        body = WholeBodyPlanner(planner.robot, mesh, tracking=True)
        watch("build", lambda planned: planned.nlp.prepare(), body)
        begin = motion_of_joints(joints, body, srmp.toe_s)
        for _ in range(NODE_REPEATS):
            plan = body.plan(task, srmp, begin=begin)
        s, solve_s = plan.solution.statistics, sum(x.cpu_s for x in plan.attempts)
        count = sum(x.iterations for x in plan.attempts)
        row = {"intervals": sum(mesh.intervals().values()), "variables": s.variables, "iterations": count}
        rows.append(row | dict(build_s=watch.cpu["build"][0], solve_s=solve_s, iteration_s=solve_s / count))
    return rows


def _spread(
    planner: Planner, ways: Mapping[str, Callable], task: JumpTask, spread: Sequence[tuple[float, float]]
) -> list[dict[str, Any]]:
    """Other targets, each planned once by three steps, and directly in both ways: CPU times [s] and their ratios; not
    those without a plan."""
    rows = []
    for distance, height in spread:
        place = {"distance_m": distance * task.distance_m, "height_m": height * task.height_m}
        other, watch = replace(task, **place), Stopwatch()
        try:
            plan = watch("plan", planner.plan, other, "three-step")
            for name in WAYS:
                watch(name, ways[name], other)
        except JumplabError:
            continue
        plan_s, direct_s, begun_s = (watch.cpu[name][0] for name in ("plan", *WAYS))
        times = {"plan_s": plan_s, "direct_s": direct_s, "ratio": plan_s / direct_s}
        times |= {"held_s": begun_s, "ratio_held": plan_s / begun_s}
        rows.append(place | times | {"clean": audit(plan.tape, planner.robot, other).passed})
    return rows
