"""The commands about many jumps: trials, certify, chain, envelope, sweep, bench."""

import json
import math
import os
import sys
import time
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from jumplab.cli import common
from jumplab.cli.common import (
    ENGINE,
    JUMP,
    METHODS,
    MODE,
    ROBOT,
    Kind,
    Late,
    command,
    folder,
    needing,
    number,
    opt,
    whole,
)
from jumplab.errors import InfeasibleError, InputError
from jumplab.task import JumpTask

store, robots, sim = Late("jumplab.io.folder"), Late("jumplab.robot"), Late("jumplab.sim")
certificates, certificate_pages = Late("jumplab.studies.certify"), Late("jumplab.show.certificate")
many, basins, chains = Late("jumplab.studies.trials"), Late("jumplab.studies.basin"), Late("jumplab.studies.chain")
maps, sweeps, benchmark = Late("jumplab.studies.envelope"), Late("jumplab.studies.sweep"), Late("jumplab.studies.bench")
pages, pictures = Late("jumplab.show.viewer"), Late("jumplab.show.jumps")
tables, style = Late("jumplab.show.tables"), Late("jumplab.show.style")

MOST, RUNS = 100_000, whole(1, 10_000)  # trials: two days of one core; chains: a day of two; more must be a typo
JOBS = needing("be a number of processes, or -1 for all processors", {"-1", *map(str, range(1, 4097))}.__contains__)
REPEATS = needing("be a number from 1 to 1000", lambda text: text.isdecimal() and 1 <= int(text) <= 1000)
FILE = needing(
    "name a file in a folder that exists",
    lambda text: text.strip() and not Path(text).is_dir() and Path(text).resolve().parent.is_dir(),
)
KEPT = "interrupted; finished trials are kept, and the same command goes on from there"
VALUES = "FROM:TO:COUNT or A,B,..."


def _count(least: int, most: float = math.inf) -> Kind:
    def kind(option: str, text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise InputError(f"{option} must be a whole number, got {text!r}") from None
        if value < least:
            raise InputError(f"{option} must be at least {least}, got {value}")
        if value > most:
            raise InputError(f"{option} must be at most {most}, got {value}")
        return value

    return kind


@command(
    opt("DIR", "folder of a plan; trials.jsonl and trials.json are written there"),
    opt("--n N", "number of robots (default 200), or of the basin's states (default: all)", None, _count(1, MOST)),
    opt("--seed S", "seed of the robots (default 0)", None, _count(0)),
    opt("--basin", "the robot as planned, from 225 wrong states at the apex; writes basin.json"),
    MODE,
    ENGINE,
    opt("--reaim", "turn the legs in the air against the trunk's pitch error", True),
    opt("--noise", "sensors err; --no-noise tells the controllers the truth", True),
    opt("--jobs J", "processes (default: one per core)", None, _count(1)),
)
def trials(args: Namespace) -> None:
    """Let many perturbed robots jump a plan."""
    start = time.perf_counter()
    if args.basin and args.seed is not None:
        raise InputError("--seed says which robots are drawn, and --basin draws none; leave one of them away")
    store.read_plan(args.dir)  # refuses a damaged folder
    store.ensure_writable(args.dir)
    noise = sim.SensorNoise.typical() if args.noise else sim.SensorNoise()
    settings = many.TrialSettings(args.mode, args.reaim, noise, engine=args.engine)
    try:
        if args.basin:
            report = basins.landing_basin(args.dir, args.n, settings, jobs=args.jobs)
        else:  # 200: a success rate near 95 % is then known to 3 % on either side
            report = many.run_trials(args.dir, args.n or 200, args.seed or 0, settings, jobs=args.jobs)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT) from None
    for what, said in report.conditions.items():
        print(f"{what}: {said}")
    low, high = report.interval
    print(f"{report.landed} of {report.count} land: {report.success_rate:.1%}, 95 % interval {low:.1%} ... {high:.1%}")
    for reason, count in report.reasons.items():
        print(f"{count:>5} failed: {reason}")
    for name, unit in (("distance", "foot_distance_m"), ("rise", "com_rise_m")):
        values = report.values(unit)
        if len(values) and not args.basin:  # they would count from the apex
            print(f"{name} of those that landed: {values.min():.3f} ... {values.max():.3f} m")
    if not (args.basin or report.in_plane) and report.landed:
        print(f"errors of those that landed: {common.misses(report.target, report.values)}")
    kept = f"{'basin' if args.basin else 'trials'}.json in {args.dir}, {report.resumed} trials from an earlier run"
    print(f"{kept}, whole run: {time.perf_counter() - start:.1f} s")


@command(
    opt("DIR", "folder of a plan; trials.jsonl, certificate.json and certificate.html are written there"),
    opt("--n N", "number of perturbed robots, in each engine and mode (default 10)", "10", _count(1, MOST)),
    opt("--seed S", "seed of the robots (default 0)", "0", _count(0)),
    opt("--jobs J", "processes (default: one per core)", None, _count(1)),
)
def certify(args: Namespace) -> None:
    """Do two physics agree on a plan? Audit, both engines, both modes."""
    start = time.perf_counter()
    store.read_plan(args.dir)  # refuses a damaged folder
    store.ensure_writable(args.dir)
    page = certificate_pages.certificate_page
    try:
        found = certificates.certify(args.dir, args.n, args.seed, page=lambda c: page(c).html, jobs=args.jobs)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT) from None
    columns = {"name": "as planned", **{name: name for name in sim.ENGINES}, "apart": "apart", "limit": "at most"}
    for mode in found.modes:
        rows = [d.to_json() for d in mode.differences]
        rows = [row | {"name": row["name"] + (", share" if row["relative"] else f" [{row['unit']}]")} for row in rows]
        print(f"{mode.mode} mode")
        print(tables.table(rows, columns))
        landed = ", ".join(f"{sum(t.landed for t in jumps)} in {name}" for name, jumps in mode.robots.items())
        print(f"perturbed robots: {landed} of {len(mode.pairs)} land, {mode.same} fare alike")
        for engine in () if found.task.in_plane else mode.planned:
            stood = [t.metrics for t in (mode.planned[engine], *mode.robots[engine]) if t.landed]
            if stood:
                errors = common.misses(asdict(found.task), lambda name, stood=stood: [getattr(m, name) for m in stood])
                print(f"errors in {engine} of those that landed: {errors}")
    kept = f"certificate.json and certificate.html in {args.dir}, {found.resumed} simulations from an earlier run"
    print(f"{kept}, whole run: {time.perf_counter() - start:.1f} s")
    if found.failures:
        more = f"; and {len(found.failures) - 1} more" if len(found.failures) > 1 else ""
        raise InfeasibleError(f"not certified: {found.failures[0]}{more}; see certificate.html in {args.dir!r}")
    print(f"certified: all {len(found.audit.checks)} checks of the audit passed, and the engines agree that it lands")


@command(
    ROBOT,
    opt("--distances-m M+", "travel of the feet, per jump [m]", None, number, required=True),
    opt("--height-m M+", "rise of the CoM in flight [m], for all jumps or per jump (default 0.3)", [0.3], number),
    opt("--platforms-m M+", "height of each landing surface above the first ground [m] (default: level)", None, number),
    opt("--sides-m M+", "travel of the feet to the left, per jump [m] (default 0)", None, number),
    opt("--turns-deg DEG+", "turn about the vertical to the left, per jump (default 0)", None, number),
    opt("--seed S", "seed of a perturbed robot (default: the robot as planned)", None, whole(0, 2**31 - 1)),
    opt("--runs N", "so many perturbed robots, from the seed on; the first is kept in full", "1", RUNS),
    opt("--ranges", "how much they differ", "slight", ("slight", "wide")),
    opt("--look-s S", "when the next jump is planned, from touchdown on [s]; negative: in the air", "-0.3", number),
    opt("--revise-s S", "when it is planned again, from touchdown on [s], or 'never'", "0.1"),
    opt("--solve-s S", "charge each plan this [s] instead of its wall clock", None, number),
    opt("--landing", "how it lands", "spring", ("planned", "spring")),
    opt("--method", "of planning", METHODS[0], METHODS),
    ENGINE,
    opt("--jobs J", "processes for several runs (default: one per core)", None, whole(1, 4096)),
    opt("--out DIR", "folder for plans, log, report and 3-D page", None, folder, required=True),
)
def chain(args: Namespace) -> None:
    """Several jumps in a row, each planned while the one before lands."""
    start = time.perf_counter()
    how = {name: getattr(args, name) for name in ("look_s", "landing", "solve_s", "method", "engine")}
    how["revise_s"] = None if args.revise_s == "never" else number("--revise-s", args.revise_s)
    seed = None if args.seed is None and args.runs == 1 else args.seed or 0
    turns = None if args.turns_deg is None else [math.radians(x) for x in args.turns_deg]
    course = chains.Course.of(args.distances_m, args.height_m, args.platforms_m, args.sides_m, turns)
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    ranges = chains.RANGES[args.ranges]
    drawn = None if seed is None else sim.Perturbation.draw(robot, seed, ranges)
    result = chains.run_chain(course, robot, perturbation=drawn, **how)
    report = None
    if args.runs > 1:
        report = chains.run_chains(course, robot, args.runs, seed, ranges=ranges, jobs=args.jobs, **how)
    where = {"scene": result.scene, "marks_m": course.goals_m}
    page = pages.page(result.robot, simulation=result, title="A chain of jumps", **where)
    audits = chains.write_chain(args.out, result, {"chain.html": page.html}, series=report and report.to_json())
    _print_chain(result, report)
    print(f"chain in {args.out}, whole run: {time.perf_counter() - start:.1f} s")
    failed = [f"jump {k}: {c.name}" for k, a in enumerate(audits, 1) for c in a.checks if not c.passed]
    if failed:
        said = f"{len(failed)} checks of the plans' audits failed ({', '.join(failed[:6])})"
        raise InfeasibleError(f"{said}; see the passport.json files in {args.out!r}")
    print(f"audit: all {sum(len(a.checks) for a in audits)} checks of {len(audits)} plans passed")
    if not result.stood:
        raise InfeasibleError(f"the chain failed: {result.reason}; see chain.json in {args.out!r}")


def _print_chain(result, report) -> None:
    """Jump by jump, then the verdict; how the perturbed robots fared, if there are any."""
    heads = ("asked", "planned", "travel", "error", "in air", "solve", "ready", "needed")
    names = ("asked_m", "planned_m", "travel_m", "error_m", "air_s", "solve_s", "ready_s", "needed_s")
    print(f"{'jump':<5}" + "".join(f"{head:>9}" for head in heads))
    for row in result.rows():
        cells = ("-" if row[n] is None else f"{row[n]:.3f} {n[-1]}" for n in names)
        print(f"{row['jump']:<5}" + "".join(f"{cell:>9}" for cell in cells))
    if not result.course.in_plane:
        print("heading off by " + ", ".join(f"{math.degrees(x):+.1f}" for x in result.heading_errors_rad) + " deg")
    ready = f"{result.in_time} of {len(result.replans)}"
    print(f"plans made on the way: {ready} were there when the robot was ready for them")
    print("chain: stands after every jump" if result.stood else f"chain: FAILED, {result.reason}")
    if report is None:
        return
    (low, high), errors = report.interval, report.errors_m
    worst = f"{abs(errors).max():.3f} m" if len(errors) else "none"
    print(f"{report.stood} of {len(report.trials)} robots stand to the end, 95 % interval {low:.1%} ... {high:.1%}")
    if not report.course.in_plane:
        off = [abs(x) for t in report.trials if t.stood for x in t.heading_errors_rad]
        print(f"largest heading error {math.degrees(max(off, default=math.nan)):.1f} deg")
    print(f"largest distance error {worst}; {report.in_time} of {report.replans} plans in time")
    print(f"{(report.waits_s <= 0).sum()} of {len(report.waits_s)} next jumps began without waiting for a plan")
    for trial in (t for t in report.trials if not t.stood):
        print(f"  seed {trial.seed}: {trial.reason}")


def _steps(option: str, text: str) -> list[float]:
    parts = [number(option, part) for part in text.split(":")]
    if len(parts) != 3 or not all(map(math.isfinite, parts)) or parts[2] <= 0 or parts[1] < parts[0]:
        raise InputError(f"{option} must be A:B:STEP with A <= B and a positive STEP, got {text!r}")
    count = min(math.floor((parts[1] - parts[0]) / parts[2] + 1e-9), 10_000)
    return [round(parts[0] + i * parts[2], 9) for i in range(count + 1)]


@command(
    ROBOT,
    opt("--out DIR", "folder for the map; an interrupted one goes on", None, folder, required=True),
    opt("--distances-m A:B:STEP", "of the cells [m]", "0:1.2:0.1", _steps),
    opt("--heights-m A:B:STEP", "of the cells [m]", "0.1:0.6:0.1", _steps),
    opt("--sides-m A:B:STEP", "map sides against distances instead, at one height [m]", None, _steps),
    opt("--turns-deg A:B:STEP", "map turns on the spot against heights instead", None, _steps),
    opt("--height-m M", "rise of the CoM in a map of sides [m] (default 0.4)", "0.4", number),
    opt("--workers N", "processes side by side", str(os.cpu_count() or 1), whole(1, 256)),
)
def envelope(args: Namespace) -> None:
    """Map of the jumps that a robot can do."""
    if args.sides_m is not None and args.turns_deg is not None:
        raise InputError("--sides-m and --turns-deg are two maps; leave one of them away")
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    values, more = (args.distances_m, args.heights_m), {}
    if args.sides_m is not None:
        fixed = JumpTask(0.0, args.height_m)
        values, more = (args.sides_m, args.distances_m), dict(axes=("side_m", "distance_m"), fixed=fixed)
    elif args.turns_deg is not None:
        turns = [math.radians(x) for x in args.turns_deg]
        values, more = (turns, args.heights_m), dict(axes=("yaw_rad", "height_m"))
    found = maps.envelope(robot, *values, **more, folder=args.out, workers=args.workers, tell=print)
    text = json.dumps(asdict(found) | {"hash": robot.hash}, indent=1).replace("NaN", "null")
    store.write_file(Path(args.out, "envelope.json"), f"{text}\n".encode())
    caption = "Cells with a plan of the direct planner, coloured by the limit of which they use most."
    style.save_figure(pictures.envelope_map(found), "envelope", args.out, caption, robot=robot)
    print(f"map in {args.out}: {sum(c.solved for c in found.cells)} of {len(found.cells)} cells have a plan")
    if found.highest is None:
        reason = next((c.reason for c in found.cells if c.reason), "no cell has a plan")
        raise InfeasibleError(f"{robot.name} can do none of these jumps: {reason}")
    for word, cell in (("highest", found.highest), ("farthest", found.farthest)):
        jump = f"{cell.distance_m:.2f} m far with a rise of {cell.height_m:.2f} m"
        if more:
            jump += f", {cell.side_m:.2f} m to the left, turned by {math.degrees(cell.yaw_rad):.0f} deg"
        print(f"{word}: {jump}, limited by {cell.limiting} ({100 * cell.share:.0f} % used)")


def values_of(option: str, text: str) -> list[float]:
    """Numbers written as FROM:TO:COUNT, or with commas."""
    parts = text.split(":")
    if len(parts) == 1:
        return [number(option, part) for part in text.split(",")]
    if len(parts) != 3 or not parts[2].isdecimal() or not 1 <= int(parts[2]) <= 10_000:
        raise InputError(f"{option} must be {VALUES}, got {text!r}")
    first, last, count = number(option, parts[0]), number(option, parts[1]), int(parts[2])
    return [round(first + (last - first) * k / max(count - 1, 1), 9) for k in range(count)]


def weights_of(pairs: list[str]) -> list[dict[str, float]]:
    """All combinations of the weights that were given."""
    found: list[dict[str, float]] = [{}]
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (name and equals):
            raise InputError(f"--weight must be TERM=A,B,..., got {pair!r}")
        found = [{**known, name: value} for known in found for value in values_of(f"--weight {name}", text)]
    return found


@command(
    opt("--distance-m M", f"{VALUES} [m] (default 0:1.2:13)", "0:1.2:13", values_of),
    opt("--height-m M", f"{VALUES} [m] (default 0.1:0.6:11)", "0.1:0.6:11", values_of),
    opt("--platform-m M", f"{VALUES} [m] (default 0)", "0", values_of),
    opt("--robot NAME...", "robot; may be repeated (default bhr)"),
    opt("--weight TERM=VALUES...", "weights of a term, as TERM=A,B,... or STAGE/TERM=A,B,...; may be repeated", []),
    opt("--method METHOD", "three-step (default) or direct", "three-step"),
    opt("--out DIR", "folder of the table; an unfinished sweep goes on", None, folder, required=True),
    opt("--jobs N", "processes (default: one per processor)", "-1", JOBS),
    opt("--cluster ADDRESS", "Dask scheduler that does the work, tcp://HOST:PORT"),
)
def sweep(args: Namespace) -> None:
    """Plans for a grid of targets, robots and weights, in one table."""
    began, weights = time.perf_counter(), weights_of(args.weight)
    axes = (args.distance_m, args.height_m, args.platform_m)
    cases = sweeps.grid(*axes, robots=args.robot or ["bhr"], weights=weights, method=args.method)
    rows = sweeps.run(cases, args.out, jobs=int(args.jobs), cluster=args.cluster)
    planned, clean = (sum(row[key] for row in rows) for key in ("planned", "clean"))
    outcome = f"{planned} planned, {clean} of them clean in the audit"
    print(f"{len(rows)} cases, {outcome}; table in {args.out}/{sweeps.TABLE}")
    print(f"whole sweep: {time.perf_counter() - began:.1f} s")


@command(
    *JUMP,
    opt("--repeats N", "how often everything is timed (default 7)", "7", REPEATS),
    opt("--json FILE", "file for ratios and all raw times", None, FILE),
)
def bench(args: Namespace) -> None:
    """How long planning takes, against one direct NLP."""
    task = JumpTask(args.distance_m, args.height_m)
    found = benchmark.bench(args.robot, task, int(args.repeats), say=lambda word: print(word, file=sys.stderr))
    print(tables.table(benchmark.rows(found), digits=3))
    print("audited clean: " + ", ".join(f"{name} {x['clean']} of {x['of']}" for name, x in found["audits"].items()))
    if args.json is not None:
        store.write_file(args.json, json.dumps(found, indent=1).encode())
        print(f"raw times in {args.json}")
