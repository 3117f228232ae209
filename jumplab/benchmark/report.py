"""What a benchmark found: ratios first, goals reached or not, then all times."""

from __future__ import annotations

import os
import platform
from importlib import metadata

import numpy as np

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
