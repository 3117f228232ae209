"""The commands about many jumps: trials, chain, envelope, record, atlas, sweep."""

import math
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jumplab as jl
from jumplab import io, sim, studies
from jumplab.cli.common import (
    disturbances,
    given,
    named,
    resumed,
    values_of,
    without,
)
from jumplab.cli.notebooks import paper
from jumplab.errors import InfeasibleError, InputError
from jumplab.task import JumpTask

TARGET = "distance_m", "height_m", "platform_m", "side_m", "yaw_rad", "gravity"
MAPS = ("side_m", "distance_m"), ("yaw_rad", "height_m")  # instead of the usual axes
CAPTION = "Cells with a plan of the direct planner, coloured by the limit of which they use most."
ASKED = {"foot_distance_m": "distance_m", "com_rise_m": "height_m"}  # metrics by another name


def trials(args: Namespace) -> None:
    """Play a plan on many perturbed robots."""
    if args.basin:
        why = "is for perturbed robots, but --basin uses the robot as planned"
        without(args, why, seed=None, disturb=[], keep_falls=0)
        without(args, "corrects the launch, but --basin begins in flight", feedback=False)
    ranges = sim.ranges_of(disturbances("--disturb", args.disturb), sim.Ranges())
    noise = sim.SensorNoise.typical() if args.noise else sim.SensorNoise()
    options = {"folder": args.dir, "settings": settings_of(args, noise=noise, ranges=ranges)}
    if args.basin:
        report = resumed(paper("basin").landing_basin, args, **options)
    else:
        n = args.n or 200  # a success rate near 95 % is then known to 3 % on either side
        seed = args.seed or 0
        report = resumed(studies.trials.run_trials, args, n=n, seed=seed, **options)
    data = report.to_json()
    args.found |= data | {"resumed": report.resumed}
    for what, condition in report.conditions.items():
        print(f"{what}: {condition}")
    print(jl.plots.table(report.rows()))
    measured = data.get("landed_metrics", {}).items()
    asked = report.target | {key: report.target[name] for key, name in ASKED.items()}
    if not JumpTask(**report.target).standing:
        asked["foot_distance_m"] = None  # the feet also travel the steps
    lengths = [{"of the landed": key, "asked": asked[key]} | x for key, x in measured if x]
    if lengths:
        print(jl.plots.table(lengths))
    print(report.line())
    name = "basin" if args.basin else "trials"
    print(f"{name}.json in {args.dir}, {report.resumed} trials from an earlier run")


def settings_of(args: Namespace, **more: Any) -> Any:
    """Settings of trials, as the options have them."""
    return studies.trials.TrialSettings(**given(studies.trials.TrialSettings, args, **more))


def chain(args: Namespace) -> None:
    """Simulate several jumps in a row, each planned while the one before lands."""
    if args.runs == 1:
        without(args, "has an effect only with several --runs", jobs=None)
        if args.seed is None:
            without(
                args,
                "is for perturbed robots, but neither --seed nor --runs asks for one",
                ranges=None,
            )
    axes = (args.distance_m, args.height_m, args.platform_m, args.side_m, args.yaw_rad)
    course = studies.chain.Course.of(*axes)
    ranges = studies.chain.RANGES[args.ranges or "slight"]
    seed = args.seed or 0
    drawn = None
    if args.seed is not None or args.runs > 1:
        drawn = sim.Perturbation.draw(args.robot, seed, ranges)
    options = given(studies.chain.run_chain, args, course=course)
    result = studies.chain.run_chain(**options, perturbation=drawn)
    series = None
    if args.runs > 1:
        options |= {"n": args.runs, "seed": seed, "ranges": ranges, "jobs": args.jobs}
        series = studies.chain.run_chains(**options)
    page = jl.plots.page(
        result.robot,
        simulation=result,
        title="A chain of jumps",
        scene=result.scene,
        marks_m=course.goals_m,
    )
    audits = studies.chain.write_chain(args.out, result, {"chain.html": page.html}, series=series)
    args.found |= {"out": args.out} | result.to_json() | {"series": series}
    _print_chain(result, series)
    print(f"chain in {args.out}")
    failed = [f"jump {k}: {c.name}" for k, a in enumerate(audits, 1) for c in a.failed]
    if failed:
        raise InfeasibleError(
            f"{len(failed)} checks of the plans' audits failed ({', '.join(failed[:6])}); "
            f"see the passport.json files in {args.out!r}"
        )
    print(f"audit: all {sum(len(a.checks) for a in audits)} checks of {len(audits)} plans passed")
    if not result.stood:
        raise InfeasibleError(f"the chain failed: {result.reason}; see chain.json in {args.out!r}")


CHAIN_COLUMNS = ("jump", "asked_m", "planned_m", "travel_m", "error_m", "heading_error_rad")
CHAIN_COLUMNS += ("air_s", "solve_s", "ready_s", "needed_s")
SERIES_COLUMNS = {
    "runs": "robots",
    "stood": "stand to the end",
    "interval": "95 % interval",
    "largest_error_m": "largest error [m]",
    "replans": "plans on the way",
    "in_time": "in time",
    "jumps": "next jumps",
    "begun_without_waiting": "begun without waiting",
}


def _print_chain(result: Any, series: dict[str, Any] | None) -> None:
    """Jump by jump, then the verdict; how the perturbed robots fared, if there are any."""
    print(jl.plots.table(result.rows(), CHAIN_COLUMNS, decimals=3))
    ready = f"{result.in_time} of {len(result.replans)}"
    print(f"plans made on the way: {ready} were there when the robot was ready for them")
    print("chain: stands after every jump" if result.stood else f"chain: FAILED, {result.reason}")
    if series is None:
        return
    low, high = series["interval"]
    row = series | {"interval": f"{low:.1%} ... {high:.1%}"}
    print(jl.plots.table([row], SERIES_COLUMNS, digits=3))
    for trial in series["trials"]:
        if not trial["stood"]:
            print("  seed {seed}: {reason}".format_map(trial))


def envelope(args: Namespace) -> None:
    """Map the jumps that a robot can do."""
    if args.side_m is not None and args.yaw_rad is not None:
        raise InputError("--side-m and --yaw-deg ask for two different maps; leave one of them out")
    if args.side_m is not None and len(args.height_m) != 1:
        raise InputError(
            f"a map of sides has one height, got {len(args.height_m)}; give --height-m one number"
        )
    axes = next((x for x in MAPS if getattr(args, x[0]) is not None), studies.envelope.AXES)
    fixed = JumpTask(0.0, args.height_m[0]) if axes[0] == "side_m" else None
    across, up = (getattr(args, name) for name in axes)
    if axes in MAPS:
        without(
            args, "holds jumps straight ahead, but this map goes to the side or turns", atlas=None
        )
    atlas = args.atlas and studies.atlas.Atlas.load(args.atlas)
    envelope = resumed(
        studies.envelope.envelope,
        args,
        "cells",
        distances=across,
        heights=up,
        axes=axes,
        fixed=fixed,
        folder=args.out,
        atlas=atlas,
    )
    figure = jl.plots.envelope_map(envelope)
    args.found["map"] = asdict(envelope) | {"hash": args.robot.hash}
    io.folder.settle()
    text = io.folder.to_json(args.found["map"])
    io.folder.write_file(Path(args.out, "envelope.json"), text.encode())
    jl.plots.save_figure(figure, "envelope", args.out, CAPTION, robot=args.robot)
    solved = sum(c.solved for c in envelope.cells)
    print(f"map in {args.out}: {solved} of {len(envelope.cells)} cells have a plan")
    if not solved:
        reason = next((c.reason for c in envelope.cells if c.reason), "no cell has a plan")
        raise InfeasibleError(f"{args.robot.name} can do none of these jumps: {reason}")
    for word, cell in (("highest", envelope.highest), ("farthest", envelope.farthest)):
        jump = jl.plots.describe_task(cell.task)
        print(f"{word}: {jump}, limited by {cell.limiting} ({100 * cell.share:.0f} % used)")


def record(args: Namespace) -> None:
    """Find the best jump of a robot in one number, such as its rise, and the limits that end it."""
    numbers = {name: getattr(args, name) for name in TARGET if getattr(args, name) is not None}
    task = JumpTask(**{"distance_m": 0.0, "height_m": 0.2} | numbers) if numbers else None
    options = given(studies.record.record, args, given=task)
    best = studies.record.record(**options)
    limits = [asdict(x) for x in best.limits]
    summary = {name: getattr(best, name) for name in ("what", "value", "unit", "bound", "found")}
    landed = {name: run.landed for name, run in best.runs.items()}
    args.found["record"] = summary | {"limits": limits, "landed": landed}
    print(best.line())
    print(f"audit: {best.audit.line()}")
    for name, run in best.runs.items():
        print(f"at {best.share:.0%} of it in {name}: {run.line()}")
    columns = ("limit", "joint", "phase", "from_s", "to_s", "worth")
    print(jl.plots.table(limits, columns, digits=3))
    if args.prices:
        prices = best.prices()
        args.found["prices"] = [asdict(row) | {"gap": row.gap} for row in prices.rows]
        print(jl.plots.table(args.found["prices"], digits=3))
        print(prices.line())
    if args.improve:
        better = best.improve({"gear": args.improve.split(",")})
        changes = [asdict(x) for x in better.changes]
        args.found["improved"] = {"changes": changes, "value": better.after.value}
        print(better.line())
        print(jl.plots.table(changes, digits=3))
        best = better.after
    if args.out:
        jl.save(args.out, best.plan)
        print(f"the plan at the record is in {args.out}")


def atlas(args: Namespace) -> None:
    """Plan a grid of targets once; plans between its nodes then start from it."""
    axes = {"distances": args.distance_m, "heights": args.height_m}
    built = resumed(studies.atlas.Atlas.build, args, "nodes", folder=args.out, **axes)
    count = math.prod(map(len, axes.values()))
    args.found |= {"out": args.out, "planned": len(built.nodes), "of": count}
    if not built.nodes:
        raise InfeasibleError(
            f"{args.robot.name} can do none of these jumps; see 'jumplab envelope'"
        )
    print(f"{built} in {args.out}; 'jumplab plan --atlas {args.out}' begins with it")


def choices_of(option: str, pairs: list[str]) -> list[dict[str, float]]:
    """All combinations of what was given as NAME=VALUES, several times."""
    choices = [{}]
    for pair in pairs:
        name, text = named(f"{option}=A,B,...", pair)
        each = values_of(f"{option.split()[0]} {name}", text)
        choices = [known | {name: value} for known in choices for value in each]
    return choices


def sweep(args: Namespace) -> None:
    """Plan a grid of targets, robots and weights, into one table."""
    weights = choices_of("--weight must be TERM", args.weight)
    if args.cluster:
        without(
            args,
            "sets processes of this machine, but --cluster does the work elsewhere",
            jobs=None,
        )
    axes = (args.distance_m, args.height_m, args.platform_m)
    names = studies.sweep.varied(
        args.robot or ["bhr"], choices_of("--vary must be WHAT", args.vary)
    )
    cases = studies.sweep.grid(*axes, robots=names, weights=weights, method=args.method)
    rows = resumed(studies.sweep.run, args, "cases", cases=cases)
    table = Path(args.out, studies.sweep.TABLE)
    args.found |= {"table": table, "rows": rows}
    planned, clean = (sum(row[key] for row in rows) for key in ("planned", "clean"))
    outcome = f"{planned} planned, {clean} passed the audit"
    print(f"{len(rows)} cases, {outcome}; table in {table}")
