"""The commands about many jumps: trials, certify, chain, envelope, sweep, bench."""

import json
import math
import os
import time
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from jumplab.cli import common
from jumplab.cli.common import (
    DISTURB,
    ENGINE,
    EXPORTED,
    FPS,
    JOBS,
    JUMP,
    METHODS,
    MODE,
    ROBOT,
    SEED,
    VALUES,
    Late,
    command,
    folder,
    needing,
    number,
    opt,
    values_of,
    whole,
    without,
)
from jumplab.errors import InfeasibleError, InputError
from jumplab.io.progress import tell
from jumplab.task import JumpTask

store, robots, sim = Late("jumplab.io.folder"), Late("jumplab.robot"), Late("jumplab.sim")
certificates, certificate_pages = Late("jumplab.studies.certify"), Late("jumplab.show.certificate")
bounds = Late("jumplab.studies.margins")
many, basins, chains = Late("jumplab.studies.trials"), Late("jumplab.studies.basin"), Late("jumplab.studies.chain")
memory = Late("jumplab.studies.atlas")
libraries = Late("jumplab.studies.clips")
maps, sweeps, benchmark = Late("jumplab.studies.envelope"), Late("jumplab.studies.sweep"), Late("jumplab.studies.bench")
pages, pictures = Late("jumplab.show.viewer"), Late("jumplab.show.jumps")
tables, style = Late("jumplab.show.tables"), Late("jumplab.show.style")

MOST = 100_000  # trials: two days of one core; more must be a typo
RUNS = whole(1, 10_000)  # of chains: a day of two cores
FILE = needing(
    "name a file in a folder that exists",
    lambda text: text.strip() and not Path(text).is_dir() and Path(text).resolve().parent.is_dir(),
)
KEPT = "interrupted; finished trials are kept, and the same command goes on from there"


def bars(args: Namespace) -> bool | None:
    """Whether bars are shown: on a terminal, and not with --quiet."""
    return False if "quiet" in args else None


@command(
    opt("DIR", "folder of a plan; trials.jsonl and trials.json are written there"),
    opt("--n N", "number of robots (default 200), or of the basin's states (default: all)", None, whole(1, MOST)),
    SEED,
    opt("--basin", "the robot as planned, from 225 wrong states at the apex; writes basin.json"),
    MODE,
    ENGINE,
    opt("--reaim", "put the legs in the air to where they can catch the robot", True),
    opt("--step", "allow one recovery step where the feet alone cannot catch the robot"),
    opt("--feedback", "correct the launch, which is open loop otherwise"),
    opt("--noise", "sensors err; --no-noise tells the controllers the truth", True),
    DISTURB,
    opt("--keep-falls N", "run the first N failures again, each into falls/NUMBER, for 'view'", "0", whole(0, 100)),
    JOBS,
)
def trials(args: Namespace) -> None:
    """Let many perturbed robots jump a plan."""
    start = time.perf_counter()
    if args.basin and args.seed is not None:
        raise InputError("--seed says which robots are drawn, and --basin draws none; leave one of them away")
    if args.basin:
        without(args, "is for robots that are drawn, and --basin draws none", disturb=[], keep_falls=0)
        without(args, "acts in launch, and the basin's states are those of a flight", feedback=None)
    ranges = sim.ranges_of(common.disturbances("--disturb", args.disturb), sim.Ranges())
    store.read_plan(args.dir)  # refuses a damaged folder
    store.ensure_writable(args.dir)
    noise = sim.SensorNoise.typical() if args.noise else sim.SensorNoise()
    answers = bool(args.step), bool(args.feedback)
    settings = many.TrialSettings(args.mode, args.reaim, noise, ranges, args.engine, *answers)
    try:
        how = {"jobs": args.jobs, "progress": bars(args)}
        if args.basin:
            report = basins.landing_basin(args.dir, args.n, settings, **how)
        else:  # 200: a success rate near 95 % is then known to 3 % on either side
            how["keep_falls"] = args.keep_falls
            report = many.run_trials(args.dir, args.n or 200, args.seed or 0, settings, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT) from None
    args.found |= report.to_json() | {"resumed": report.resumed}
    for what, said in report.conditions.items():
        print(f"{what}: {said}")
    low, high = report.interval
    steps = f" ({report.stepped} with a recovery step)" if args.step else ""
    rate = f"{report.success_rate:.1%}, 95 % interval {low:.1%} ... {high:.1%}"
    print(f"{report.landed} of {report.count} land{steps}: {rate}")
    for reason, count in report.reasons.items():
        print(f"{count:>5} failed: {reason}")
    if report.causes:
        print("first signs of the failures: " + ", ".join(f"{count} {name}" for name, count in report.causes.items()))
    for name, unit in (("distance", "foot_distance_m"), ("rise", "com_rise_m")):
        values = report.values(unit)
        if len(values) and not args.basin:  # they would count from the apex
            print(f"{name} of those that landed: {values.min():.3f} ... {values.max():.3f} m")
    if not (args.basin or report.in_plane) and report.landed:
        print(f"errors of those that landed: {common.misses(report.target, report.values)}")
    kept = f"{'basin' if args.basin else 'trials'}.json in {args.dir}, {report.resumed} trials from an earlier run"
    print(f"{kept}, whole run: {time.perf_counter() - start:.1f} s")


@command(
    opt("DIR", "folder of a plan; trials.jsonl and margins.json are written there"),
    opt("--disturb NAME...", "only these; A+B for two together; a wrong name shows all; may be repeated", []),
    opt("--n N", "number of robots at each size (default 20)", "20", whole(1, MOST)),
    opt("--step", "allow one recovery step where the feet alone cannot catch the robot"),
    opt("--feedback", "correct the launch, which is open loop otherwise"),
    opt("--steps N", "of the bisection (default 4, to a sixteenth of the limit)", "4", whole(0, 20)),
    SEED,
    MODE,
    ENGINE,
    JOBS,
)
def margins(args: Namespace) -> None:
    """How much of each disturbance a plan bears."""
    start = time.perf_counter()
    store.read_plan(args.dir)  # refuses a damaged folder
    store.ensure_writable(args.dir)
    settings = many.TrialSettings(args.mode, engine=args.engine, step=bool(args.step), feedback=bool(args.feedback))
    names = args.disturb or (*bounds.SINGLE, *bounds.PAIRS)
    try:
        how = {"steps": args.steps, "jobs": args.jobs, "progress": bars(args)}
        report = bounds.margins(args.dir, names, args.n, args.seed or 0, settings, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT) from None
    args.found |= report.to_json()
    print(tables.table([margin.row() for margin in report.margins], digits=3))
    print(f"{report.line()}; margins.json in {args.dir}, whole run: {time.perf_counter() - start:.1f} s")


@command(
    opt("DIR", "folder of a plan; trials.jsonl, certificate.json and certificate.html are written there"),
    opt("--n N", "number of perturbed robots, in each engine and mode (default 10)", "10", whole(1, MOST)),
    SEED,
    JOBS,
)
def certify(args: Namespace) -> None:
    """Do two physics agree on a plan? Audit, both engines, both modes."""
    start = time.perf_counter()
    store.read_plan(args.dir)  # refuses a damaged folder
    store.ensure_writable(args.dir)
    page = certificate_pages.certificate_page
    try:
        how = {"jobs": args.jobs, "progress": bars(args)}
        found = certificates.certify(args.dir, args.n, args.seed or 0, page=lambda c: page(c).html, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT) from None
    args.found |= found.to_json()
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
    opt(
        "--out DIR", "folder for index.json and the clips; an interrupted library goes on", None, folder, required=True
    ),
    opt("--format", "of the clips (default mjlab-npz)", "mjlab-npz", EXPORTED),
    FPS,
    opt("--only NAME+", "names of clips, such as forward-1 (default: all thirty)"),
    JOBS,
)
def clips(args: Namespace) -> None:
    """Thirty jumps to all sides, planned, audited, landed alike in both engines, as clips."""
    start, robot = time.perf_counter(), robots.Robot.load(args.robot)
    how = dict(fps=args.fps, only=args.only, jobs=args.jobs, say=print)
    try:
        found = libraries.make_clips(robot, args.out, args.format, **how)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(KEPT.replace("trials", "clips")) from None
    args.found |= {"out": args.out} | found.to_json()
    count = len(found.rows) + len(found.left_out)
    print(f"{len(found.rows)} of {count} clips passed; index.json in {args.out}")
    print(f"whole library: {time.perf_counter() - start:.1f} s")
    if not found.rows:
        raise InfeasibleError(f"no clip of {robot.name} passed: {found.left_out[0]['reasons'][0]}")


@command(
    ROBOT,
    opt("--distance-m M", f"travel of the feet, per jump: {VALUES} [m]", None, values_of, required=True),
    opt("--height-m M", f"rise of the CoM in flight, for all jumps or per jump: {VALUES} [m]", "0.3", values_of),
    opt("--platform-m M", f"landing surfaces above the first ground: {VALUES} [m] (default: level)", None, values_of),
    opt("--side-m M", f"travel of the feet to the left, per jump: {VALUES} [m] (default 0)", None, values_of),
    opt("--yaw-deg DEG", f"turn about the vertical to the left, per jump: {VALUES} [deg] (default 0)", None, values_of),
    opt("--seed S", "seed of a perturbed robot (default: the robot as planned)", None, whole(0, 2**31 - 1)),
    opt("--runs N", "so many perturbed robots, from the seed on; the first is kept in full", "1", RUNS),
    opt("--ranges", "how much they differ (default slight)", None, ("slight", "wide")),
    opt("--look-s S", "when the next jump is planned, from touchdown on [s]; negative: in the air", "-0.3", number),
    opt("--revise-s S", "when it is planned again, from touchdown on [s], or 'never'", "0.1"),
    opt("--solve-s S", "charge each plan this [s] instead of its wall clock", None, number),
    opt("--landing", "how it lands", "spring", ("planned", "spring")),
    opt("--method", "of planning (default direct)", "direct", METHODS),
    ENGINE,
    JOBS,
    opt("--out DIR", "folder for plans, log, report and 3-D page", None, folder, required=True),
)
def chain(args: Namespace) -> None:
    """Several jumps in a row, each planned while the one before lands."""
    start = time.perf_counter()
    if args.runs == 1:
        without(args, "is for several --runs", jobs=None)
        if args.seed is None:
            without(args, "says how perturbed robots differ, and neither --seed nor --runs asks for one", ranges=None)
    how = {name: getattr(args, name) for name in ("look_s", "landing", "solve_s", "method", "engine")}
    how["revise_s"] = None if args.revise_s == "never" else number("--revise-s", args.revise_s)
    seed = None if args.seed is None and args.runs == 1 else args.seed or 0
    turns = None if args.yaw_deg is None else [math.radians(x) for x in args.yaw_deg]
    course = chains.Course.of(args.distance_m, args.height_m, args.platform_m, args.side_m, turns)
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    ranges = chains.RANGES[args.ranges or "slight"]
    drawn = None if seed is None else sim.Perturbation.draw(robot, seed, ranges)
    result = chains.run_chain(course, robot, perturbation=drawn, **how)
    report = None
    if args.runs > 1:
        report = chains.run_chains(course, robot, args.runs, seed, ranges=ranges, jobs=args.jobs, **how)
    where = {"scene": result.scene, "marks_m": course.goals_m}
    page = pages.page(result.robot, simulation=result, title="A chain of jumps", **where)
    audits = chains.write_chain(args.out, result, {"chain.html": page.html}, series=report and report.to_json())
    args.found |= {"out": args.out} | result.to_json() | {"series": report and report.to_json()}
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


@command(
    ROBOT,
    opt("--out DIR", "folder for the map; an interrupted one goes on", None, folder, required=True),
    opt("--distance-m M", f"of the cells: {VALUES} [m] (default 0:1.2:13)", "0:1.2:13", values_of),
    opt("--height-m M", f"of the cells: {VALUES} [m] (default 0.1:0.6:6)", "0.1:0.6:6", values_of),
    opt("--side-m M", f"sides against distances instead, at one height: {VALUES} [m]", None, values_of),
    opt("--yaw-deg DEG", f"turns on the spot against heights instead: {VALUES}", None, values_of),
    opt("--atlas DIR", "folder of an atlas to begin with ('jumplab atlas')", None, folder),
    JOBS,
)
def envelope(args: Namespace) -> None:
    """Map of the jumps that a robot can do."""
    if args.side_m is not None and args.yaw_deg is not None:
        raise InputError("--side-m and --yaw-deg are two maps; leave one of them away")
    if args.side_m is not None and len(args.height_m) != 1:
        raise InputError(f"a map of sides has one height, got {len(args.height_m)}; give --height-m one number")
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    values, more, jobs = (args.distance_m, args.height_m), {}, args.jobs or os.cpu_count() or 1
    if args.side_m is not None:
        fixed = JumpTask(0.0, args.height_m[0])
        values, more = (args.side_m, args.distance_m), dict(axes=("side_m", "distance_m"), fixed=fixed)
    elif args.yaw_deg is not None:
        values, more = ([math.radians(x) for x in args.yaw_deg], args.height_m), dict(axes=("yaw_rad", "height_m"))
    if more:
        without(args, "holds jumps straight ahead", atlas=None)
    known = args.atlas and memory.Atlas.load(args.atlas)
    found = maps.envelope(robot, *values, **more, folder=args.out, workers=jobs, tell=print, atlas=known)
    figure, args.found["map"] = pictures.envelope_map(found), asdict(found) | {"hash": robot.hash}
    store.settle()
    text = json.dumps(args.found["map"], indent=1).replace("NaN", "null")
    store.write_file(Path(args.out, "envelope.json"), f"{text}\n".encode())
    caption = "Cells with a plan of the direct planner, coloured by the limit of which they use most."
    style.save_figure(figure, "envelope", args.out, caption, robot=robot)
    print(f"map in {args.out}: {sum(c.solved for c in found.cells)} of {len(found.cells)} cells have a plan")
    if found.highest is None:
        reason = next((c.reason for c in found.cells if c.reason), "no cell has a plan")
        raise InfeasibleError(f"{robot.name} can do none of these jumps: {reason}")
    for word, cell in (("highest", found.highest), ("farthest", found.farthest)):
        jump = f"{cell.distance_m:.2f} m far with a rise of {cell.height_m:.2f} m"
        if more:
            jump += f", {cell.side_m:.2f} m to the left, turned by {math.degrees(cell.yaw_rad):.0f} deg"
        print(f"{word}: {jump}, limited by {cell.limiting} ({100 * cell.share:.0f} % used)")


@command(
    ROBOT,
    opt("--out DIR", "folder for atlas.npz; an interrupted one goes on", None, folder, required=True),
    opt("--distance-m M", f"of the nodes: {VALUES} [m] (default 0:1.2:7)", "0:1.2:7", values_of),
    opt("--height-m M", f"of the nodes: {VALUES} [m] (default 0.1:0.6:6)", "0.1:0.6:6", values_of),
    JOBS,
)
def atlas(args: Namespace) -> None:
    """Plan a grid once: any target between its nodes is then a few steps away."""
    began, robot = time.perf_counter(), robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    axes, jobs = (args.distance_m, args.height_m), args.jobs or os.cpu_count() or 1
    found = memory.Atlas.build(robot, *axes, folder=args.out, jobs=jobs, tell=print)
    args.found |= {"out": args.out, "planned": len(found.nodes), "of": math.prod(map(len, axes))}
    if not found.nodes:
        raise InfeasibleError(f"{robot.name} can do none of these jumps; see 'jumplab envelope'")
    print(f"{found} in {args.out}; 'jumplab plan --atlas {args.out}' begins with it")
    print(f"whole atlas: {time.perf_counter() - began:.1f} s")


def choices_of(option: str, pairs: list[str]) -> list[dict[str, float]]:
    """All combinations of what was given as NAME=VALUES, several times."""
    found: list[dict[str, float]] = [{}]
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (name and equals):
            raise InputError(f"{option}=A,B,..., got {pair!r}")
        found = [{**known, name: value} for known in found for value in values_of(f"{option.split()[0]} {name}", text)]
    return found


@command(
    opt("--distance-m M", f"travel of the feet: {VALUES} [m] (default 0:1.2:13)", "0:1.2:13", values_of),
    opt("--height-m M", f"{VALUES} [m] (default 0.1:0.6:11)", "0.1:0.6:11", values_of),
    opt("--platform-m M", f"{VALUES} [m] (default 0)", "0", values_of),
    opt("--robot NAME...", "robot; may be repeated (default bhr)"),
    opt("--vary WHAT=VALUES...", "factors on mass, effort, speed or leg of every robot; may be repeated", []),
    opt("--weight TERM=VALUES...", "weights of a term, as TERM=A,B,... or STAGE/TERM=A,B,...; may be repeated", []),
    opt("--method", "of planning (default direct)", "direct", METHODS),
    opt("--out DIR", "folder of the table; an unfinished sweep goes on", None, folder, required=True),
    JOBS,
    opt("--cluster ADDRESS", "Dask scheduler that does the work, tcp://HOST:PORT"),
    opt("--atlas", "build a small atlas of every robot first, and begin direct plans with it"),
    opt("--tapes HZ", "also keep the motions, so many rows a second, in DIR/tapes", None, number),
)
def sweep(args: Namespace) -> None:
    """Plans for a grid of targets, robots and weights, in one table."""
    began, weights = time.perf_counter(), choices_of("--weight must be TERM", args.weight)
    if args.cluster:
        without(args, "is for processes of this machine, and --cluster does the work elsewhere", jobs=None)
    axes = (args.distance_m, args.height_m, args.platform_m)
    names = sweeps.varied(args.robot or ["bhr"], choices_of("--vary must be WHAT", args.vary))
    cases = sweeps.grid(*axes, robots=names, weights=weights, method=args.method)
    rows = sweeps.run(
        cases,
        args.out,
        jobs=args.jobs or -1,
        cluster=args.cluster,
        progress=bars(args),
        atlas=args.atlas,
        tapes_hz=args.tapes,
    )
    args.found |= {"table": Path(args.out, sweeps.TABLE), "rows": rows}
    planned, clean = (sum(row[key] for row in rows) for key in ("planned", "clean"))
    outcome = f"{planned} planned, {clean} of them clean in the audit"
    print(f"{len(rows)} cases, {outcome}; table in {args.out}/{sweeps.TABLE}")
    print(f"whole sweep: {time.perf_counter() - began:.1f} s")


@command(
    *JUMP,
    opt("--repeats N", "how often every plan is timed (default 3)", "3", whole(1, 1000)),
    opt("--out FILE", "file for all raw times, as JSON", None, FILE),
)
def bench(args: Namespace) -> None:
    """How long planning takes: straight ahead, from a neighbour, from an atlas, in three steps, aside, flips."""
    task = JumpTask(args.distance_m, args.height_m)
    found = benchmark.bench(args.robot, task, args.repeats, say=tell)
    args.found |= found
    print(tables.table(found["rows"], benchmark.COLUMNS, digits=3))
    if args.out is not None:
        store.settle()
        store.write_file(args.out, json.dumps(found, indent=1).encode())
        print(f"raw times in {args.out}")
