"""The commands about one jump and its folder: run, plan, audit, simulate, view, export."""

import ast
import json
import math
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

from jumplab.cli import common
from jumplab.cli.common import (
    DISTURB,
    ENGINE,
    EXPORTED,
    FPS,
    JUMP,
    METHODS,
    MODE,
    PLAN,
    SEED,
    Late,
    command,
    folder,
    needing,
    number,
    opt,
)
from jumplab.errors import InputError
from jumplab.sim import ENGINES
from jumplab.task import JumpTask

store, motions, exports = Late("jumplab.io.folder"), Late("jumplab.io.motion"), Late("jumplab.io.export")
robots, planner, auditing = Late("jumplab.robot"), Late("jumplab.stages.planner"), Late("jumplab.auditing")
sim, pages, notebooks = Late("jumplab.sim"), Late("jumplab.show.viewer"), Late("jumplab.cli.notebooks")
advice, memory = Late("jumplab.studies.advice"), Late("jumplab.studies.atlas")
allowances = Late("jumplab.studies.robust")
movies = Late("jumplab.show.movies")

HTML = needing("name a file that ends in .html", lambda text: text.lower().endswith(".html"))
MOVIE = needing("name a file that ends in .gif or .mp4", lambda text: text.lower().endswith((".gif", ".mp4")))


@command(
    *JUMP,
    opt("NOTEBOOK*", "which ones, as 00 or 02_srmp (default: all)"),
    opt("--out DIR", "results and executed notebooks (default: executed/ in the checkout, else here)", None, folder),
    opt("--figures DIR", "figures (default: DIR/figures with --out, else figures/ in the checkout)", None, folder),
    opt("--engine", "physics engine of the simulations (default: the first that is installed)", None, tuple(ENGINES)),
    common.JOBS,
    opt("-p --parameter NAME=VALUE...", "any further parameter that a notebook declares; may be repeated", []),
)
def run(args: Namespace) -> None:
    """Execute the notebooks: plan, audit, simulation, figures."""
    task = JumpTask(args.distance_m, args.height_m)
    values = {"distance_m": task.distance_m, "height_m": task.height_m, "robot": args.robot}
    if args.engine is not None:
        values["engine"] = args.engine
    for pair in args.parameter:
        name, equals, text = pair.partition("=")
        if not (equals and name.isidentifier()):
            raise InputError(f"--parameter must be NAME=VALUE, got {pair!r}")
        if name in values:
            raise InputError(f"--parameter {name} is given twice, or has an option of its own")
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            values[name] = text
    chosen = notebooks.find_notebooks(args.notebook)
    shown = "quiet" not in args
    how = {"out": args.out, "figures": args.figures, "progress": shown, "jobs": args.jobs}
    report = notebooks.run_notebooks(values, notebooks=chosen, **how)
    args.found |= {name: getattr(report, name) for name in ("out", "figures", "notebooks", "wall_s")}
    if (report.out / "plan.npz").is_file():
        common.print_summary(summary := store.read_plan(report.out)[2])
        args.found["plan"] = summary
    if (report.out / "simulation.json").is_file():
        common.print_simulation(simulated := store.read_json(report.out / "simulation.json"))
        args.found["simulation"] = simulated
    print(f"figures in {report.figures}, results and executed notebooks in {report.out}")
    if (report.out / "jump.html").is_file():
        print(f"the jump in 3-D, for any browser: {report.out / 'jump.html'}")
    print(f"whole run: {report.wall_s:.1f} s")


@command(
    *JUMP,
    opt("--out DIR", "folder for the plan", None, folder, required=True),
    opt("--platform-m M", "height of the landing surface [m] (default 0)", "0", number),
    opt("--rotation-deg DEG", "0 or a multiple of 360; -360 is a backflip", "0", number),
    opt("--side-m M", "travel of the feet to the left [m] (default 0)", "0", number),
    opt("--yaw-deg DEG", "turn about the vertical, counter-clockwise, -360 to 360 (default 0)", "0", number),
    opt("--method", "the whole body alone, which is usual, or the paper's three steps", "usual", ("usual", *METHODS)),
    opt("--atlas DIR", "folder of an atlas to begin with ('jumplab atlas'); the method is then direct", None, folder),
    opt("--robust", "allow for robots that differ as those of 'trials' do, and as --disturb says"),
    DISTURB,
)
def plan(args: Namespace) -> None:
    """The optimisations and the audit alone."""
    start = time.perf_counter()
    turns = {"rotation_rad": math.radians(args.rotation_deg), "yaw_rad": math.radians(args.yaw_deg)}
    task = JumpTask(args.distance_m, args.height_m, args.platform_m, side_m=args.side_m, **turns)
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    known, changes = args.atlas and memory.Atlas.load(args.atlas), {}
    if args.robust:
        ranges = sim.ranges_of(common.disturbances("--disturb", args.disturb), sim.Ranges())
        changes = allowances.robust_changes(task, robot, ranges, {})
    else:
        common.without(args, "says what --robust allows for, which is not given", disturb=[])
    found = advice.plan_or_advise(planner.Planner(robot, keep=True, atlas=known, **changes), task, args.method)
    report = store.write_plan(args.out, found.tape, found.robot, found.summary, complete=auditing.write_audit)
    args.found |= {"out": args.out, "plan": found.summary, "audit": _audited(report)}
    common.print_summary(found.summary)
    print(f"plan in {args.out}, whole run: {time.perf_counter() - start:.1f} s")
    common.judge(report, args.out)


@command(PLAN)
def audit(args: Namespace) -> None:
    """Check a plan by a second code path."""
    store.read_plan(args.dir)  # refuses a damaged folder
    folder = store.ensure_writable(args.dir)
    with store.transaction(folder) as staging:
        report = auditing.write_audit(folder, into=staging)
    args.found |= _audited(report)
    print(report.table())
    common.judge(report, args.dir)


def _audited(report: Any) -> dict[str, Any]:
    return json.loads(report.to_json())


@command(PLAN, MODE, ENGINE, DISTURB, SEED)
def simulate(args: Namespace) -> None:
    """Simulate a plan in PyBullet or MuJoCo."""
    fixed = {k: (x * 2 if len(x) == 1 and sim.is_pair(k) else x)
             for k, x in common.disturbances("--disturb", args.disturb).items()}  # fmt: skip
    ranges = sim.ranges_of(fixed)
    if not fixed:
        common.without(args, "says where --disturb acts, which is not given", seed=None)
    tape, robot, summary = store.read_plan(args.dir)
    store.ensure_writable(args.dir)
    scene = sim.Scene.of_plan(summary, robot)
    drawn = sim.Perturbation.draw(robot, args.seed or 0, ranges) if fixed else None
    result = sim.simulate_jump(tape, robot, mode=args.mode, scene=scene, engine=args.engine, perturbation=drawn)
    store.write_simulation(args.dir, result, summary)
    args.found |= result.to_json()
    common.print_simulation(result.to_json())


@command(
    opt("DIR", "folder of a plan, simulated or not"),
    opt("--out FILE.html", "file to write (default: DIR/jump.html)", None, HTML),
    opt("--movie FILE", "a moving picture instead of the page: a file that ends in .gif or .mp4", None, MOVIE),
)
def view(args: Namespace) -> None:
    """A jump in 3-D, as one HTML file, or as a moving picture."""
    if args.movie:
        common.without(args, "names the page, and --movie is given instead of it", out=None)
    tape, robot, summary = store.read_plan(args.dir)
    path = Path(args.movie or args.out or Path(args.dir, "jump.html"))
    store.ensure_writable(path.parent)
    simulated = Path(args.dir, motions.SIMULATION_NAME).is_file()
    simulation = motions.Motion.of_simulation_file(args.dir, robot) if simulated else None
    told = store.read_json(Path(args.dir, "simulation.json")) if simulated else {}
    task, scene = JumpTask(**summary["target"]), sim.Scene.of_run(told, summary, robot)
    if args.movie:
        made = movies.write_movie(path, robot, simulation or tape, scene)
        size = path.stat().st_size
        args.found |= {"file": path, "bytes": size, "frames": made.frames, "drawn_by": made.drawn_by}
        print(f"{made.frames} frames, {made.seconds:.1f} s at half speed: {path}, {size / 1e6:.1f} MB")
        return
    page = pages.page(robot, plan=tape, simulation=simulation, task=task, scene=scene)
    page.save(path)
    args.found |= {"file": path, "bytes": path.stat().st_size, "title": page.title}
    print(f"{page.title}: {path}, {path.stat().st_size / 1e6:.1f} MB; open it in any browser")


@command(
    PLAN,
    opt("--format", "joint table, arrays, folder to replay; what trackers read", None, EXPORTED, required=True),
    opt("--out PATH", "file, or folder of urdf-replay and mujoco (default: in DIR)", None, folder),
    opt("--simulated", "the simulated jump, to its standing end, instead of the planned one, to touchdown"),
    FPS,
)
def export(args: Namespace) -> None:
    """A jump of the whole robot for other programs."""
    tape, robot, _ = store.read_plan(args.dir)
    motion = motions.Motion.of_simulation_file(args.dir, robot) if args.simulated else motions.Motion.of(tape)
    path = Path(args.out or Path(args.dir, exports.default_name(args.format, motion.source)))
    exports.write(args.format, motion, robot, path, fps=args.fps)
    args.found |= {"file": path, "format": args.format, "source": motion.source, "duration_s": motion.duration}
    said = f"{motion.source}{'' if args.simulated else ' to touchdown'}, {motion.duration:.3f} s"
    print(f"{said}, as {args.format}: {path}")
