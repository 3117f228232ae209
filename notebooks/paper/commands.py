"""Commands whose work is done beside the notebooks: run, margins, certify, clips, bench."""

from __future__ import annotations

import ast
import json
from argparse import Namespace

import jumplab as jl
from jumplab import io
from jumplab.cli.common import given, named, print_simulation, print_summary, resumed
from jumplab.cli.notebooks import find_notebooks, paper
from jumplab.cli.studies import choices_of, settings_of
from jumplab.errors import InfeasibleError, InputError
from jumplab.io.progress import tell
from jumplab.task import JumpTask


def run(args: Namespace) -> None:
    """Execute the notebooks: plan, audit, simulation, figures."""
    task = JumpTask(args.distance_m, args.height_m)
    values = {"distance_m": task.distance_m, "height_m": task.height_m, "robot": args.robot}
    if args.engine is not None:
        values["engine"] = args.engine
    for pair in args.parameter:
        name, text = named("--parameter must be NAME=VALUE", pair)
        if name in values:
            raise InputError(
                f"--parameter {name} is given twice, or has an option of its own; set it once"
            )
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            values[name] = text
    run_notebooks = paper("running").run_notebooks
    options = given(run_notebooks, args, progress="quiet" not in args)
    report = run_notebooks(values, notebooks=find_notebooks(args.notebook), **options)
    args.found |= vars(report)
    if (report.out / "plan.npz").is_file():
        args.found["plan"] = io.folder.read_plan(report.out)[2]
        print_summary(args.found["plan"])
    if (report.out / "simulation.json").is_file():
        args.found["simulation"] = io.folder.read_json(report.out / "simulation.json")
        print_simulation(args.found["simulation"])
    print(f"figures in {report.figures}, results and executed notebooks in {report.out}")
    if (report.out / "jump.html").is_file():
        print(f"the jump in 3-D, for any browser: {report.out / 'jump.html'}")
    print(f"whole run: {report.wall_s:.1f} s")


def margins(args: Namespace) -> None:
    """Find the largest size of each disturbance that a plan tolerates."""
    search = paper("margins")
    names = args.disturb or (*search.SINGLE, *search.PAIRS)
    options = {"folder": args.dir, "seed": args.seed or 0, "settings": settings_of(args)}
    report = resumed(search.margins, args, names=names, **options)
    args.found |= report.to_json()
    print(jl.plots.table([margin.row() for margin in report.margins], digits=3))
    print(f"{report.line()}; margins.json in {args.dir}")


def certify(args: Namespace) -> None:
    """Certify a plan: audit, then both physics engines in some modes, with both contacts."""
    engines = paper("certify")
    options = {"folder": args.dir, "seed": args.seed or 0}
    certificate = resumed(engines.certify, args, **options)
    args.found |= certificate.to_json()
    for mode in certificate.modes:
        print(f"{mode.mode} mode: the engines {'agree' if mode.agree else 'do not agree'}")
        print(jl.plots.table(mode.differences, engines.COLUMNS, digits=3))
        landed = ", ".join(f"{count} in {name}" for name, count in mode.landed.items())
        print(
            f"perturbed robots: {landed} of {len(mode.pairs)} land, {mode.same} have the same "
            f"outcome"
        )
    for engine, trial in certificate.usual.items():
        print(f"usual contact, {engine}: {trial.reason}")
    print(
        f"certificate.json and certificate.html in {args.dir}, {certificate.resumed} simulations "
        f"from an earlier run"
    )
    if failures := certificate.failures:
        more = f"; and {len(failures) - 1} more" if len(failures) > 1 else ""
        raise InfeasibleError(
            f"not certified: {failures[0]}{more}; see certificate.html in {args.dir!r}"
        )
    checks = len(certificate.audit.checks)
    print(
        f"certified: all {checks} checks of the audit passed, and the engines agree that it lands "
        f"({certificate.scope})"
    )


def clips(args: Namespace) -> None:
    """Make a library of clips: a hundred jumps to all sides, audited and landed in both engines."""
    library = paper("library")
    draw = library.draw_film if args.films else library.draw_strip
    vary = choices_of("--vary must be WHAT", args.vary) if args.vary else []
    options = {"format_name": args.format, "vary": vary, "draw": draw, "say": print}
    make_clips = paper("clips").make_clips
    found = resumed(make_clips, args, "clips", page=library.clips_page, **options)
    args.found |= {"out": args.out} | found
    passed = len(found["clips"])
    count = passed + len(found["left_out"])
    print(f"{passed} of {count} clips passed; index.json and index.html in {args.out}")
    if not passed:
        reason = found["left_out"][0]["reasons"][0]
        raise InfeasibleError(f"no clip of {args.robot.name} passed: {reason}")


def bench(args: Namespace) -> None:
    """Measure the time of planning, one kind of jump and one method after another."""
    task = JumpTask(args.distance_m, args.height_m)
    benchmark = paper("planning_times")
    times = benchmark.bench(args.robot, task, args.repeats, say=tell)
    args.found |= times
    print(jl.plots.table(times["rows"], benchmark.COLUMNS, digits=3))
    if args.out is not None:
        io.folder.settle()
        io.folder.write_file(args.out, json.dumps(times, indent=1).encode())
        print(f"raw times in {args.out}")
