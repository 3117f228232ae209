"""The commands about one jump and its folder: plan, audit, simulate, view, export."""

import json
import time
import warnings
from argparse import Namespace
from dataclasses import fields
from pathlib import Path
from typing import Any

import jumplab as jl
from jumplab import io, sim, studies
from jumplab.cli.common import (
    disturbances,
    given,
    judge,
    print_simulation,
    print_summary,
    without,
)
from jumplab.task import JumpTask


def plan(args: Namespace) -> None:
    """Plan and audit a jump, without the notebooks."""
    start = time.perf_counter()
    task = JumpTask(**given(JumpTask, args))
    if args.contacts:
        why = "cannot be used with --contacts, which gives a schedule instead of a target"
        usual = {f.name: f.default for f in fields(JumpTask)[2:]}
        usual |= {"distance_m": 1.0, "height_m": 0.5, "like": None}
        without(args, why, **usual, robust=False, atlas=None, starts=1)
        task = None
    atlas = args.atlas and studies.atlas.Atlas.load(args.atlas)
    ranges = None
    if args.robust:
        ranges = sim.ranges_of(disturbances("--disturb", args.disturb), sim.Ranges())
    else:
        without(args, "has an effect only with --robust, which is not given", disturb=[])
    with warnings.catch_warnings(action="ignore"):  # the audit is told below
        plan = jl.plan(**given(jl.plan, args, task=task, robust=ranges, atlas=atlas))
    report = jl.save(args.out, plan)
    args.found |= {"out": args.out, "plan": plan.summary, "audit": _audited(report)}
    print_summary(plan.summary)
    if args.starts > 1:
        print(jl.plots.table([vars(x) for x in plan.attempts], digits=3))
    print(f"plan in {args.out}, whole run: {time.perf_counter() - start:.1f} s")
    judge(report, args.out)


def audit(args: Namespace) -> None:
    """Check a plan with an independent implementation."""
    from jumplab.auditing import write_audit

    report = write_audit(args.dir)
    args.found |= _audited(report)
    print(report.table())
    judge(report, args.dir)


def _audited(report: Any) -> dict[str, Any]:
    return json.loads(report.to_json())


def simulate(args: Namespace) -> None:
    """Simulate a plan in PyBullet or MuJoCo."""
    sizes = disturbances("--disturb", args.disturb)
    for name, size in sizes.items():
        if len(size) == 1 and sim.is_pair(name):
            sizes[name] = size * 2
    ranges = sim.ranges_of(sizes)  # refuses unknown names
    drawn = None
    if not sizes:
        without(args, "has an effect only with --disturb, which is not given", seed=None)
    tape, robot, summary = io.folder.read_plan(args.dir)
    io.folder.ensure_writable(args.dir)
    if sizes:
        drawn = sim.Perturbation.draw(robot, args.seed or 0, ranges)
    scene = sim.Scene.of_plan(summary, robot)
    options = given(sim.simulate_jump, args, scene=scene, perturbation=drawn)
    result = sim.simulate_jump(tape, robot, **options)
    io.folder.write_simulation(args.dir, result, summary)
    metrics = result.to_json()
    args.found |= metrics
    print_simulation(metrics)


def view(args: Namespace) -> None:
    """Show a jump in 3-D, as one HTML file, or make an animation of it."""
    if args.movie:
        without(args, "names the page, but --movie makes an animation instead", out=None)
    tape, robot, summary = io.folder.read_plan(args.dir)
    path = Path(args.movie or args.out or Path(args.dir, "jump.html"))
    io.folder.ensure_writable(path.parent)
    simulation, settings = None, {}
    if Path(args.dir, io.motion.SIMULATION_NAME).is_file():
        simulation = io.motion.Motion.of_simulation_file(args.dir, robot)
        settings = io.folder.read_json(Path(args.dir, "simulation.json"))
    scene = sim.Scene.of_run(settings, summary, robot)
    if args.movie:
        from jumplab.show.movies import write_movie

        film = write_movie(path, robot, simulation or tape, scene)
        args.found |= {"frames": film.frames, "drawn_by": film.drawn_by}
        words = f"{film.frames} frames, {film.seconds:.1f} s at half speed"
        hint = ""
    else:
        task = JumpTask.of(summary["target"])
        page = jl.plots.page(robot, plan=tape, simulation=simulation, task=task, scene=scene)
        page.save(path)
        args.found["title"] = words = page.title
        hint = "; open it in any browser"
    size = path.stat().st_size
    args.found |= {"file": path, "bytes": size}
    print(f"{words}: {path}, {size / 1e6:.1f} MB{hint}")


def export(args: Namespace) -> None:
    """Export a jump of the whole robot for other programs."""
    tape, robot, _ = io.folder.read_plan(args.dir)
    motion = io.motion.Motion.of(tape)
    if args.simulated:
        motion = io.motion.Motion.of_simulation_file(args.dir, robot)
    source = motion.source
    path = Path(args.out or Path(args.dir, io.export.default_name(args.format, source)))
    io.export.write(args.format, motion, robot, path, fps=args.fps)
    args.found |= {"file": path, "format": args.format, "source": source}
    args.found["duration_s"] = motion.duration
    until = "" if args.simulated else " to touchdown"
    print(f"{source}{until}, {motion.duration:.3f} s, as {args.format}: {path}")
