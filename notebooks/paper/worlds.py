"""Harder worlds: how many perturbed robots land in each, with the legs re-aimed in the air and without; and drawn plans
on the contacts, friction and motors that nobody planned for.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import fields
from itertools import chain, product
from operator import itemgetter
from pathlib import Path
from typing import Any

import joblib
import numpy as np

import jumplab as jl
from jumplab.control.kinematics import rotation
from jumplab.errors import SolverError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import ENGINES, STEP_S, Perturbation, Ranges, Scene, SimulationResult, simulate_jump
from jumplab.studies.study import in_parallel
from jumplab.studies.trials import TrialSettings, run_trials, wilson
from paper import logs, runs
from paper.margins import MarginReport, ranges_at

LOG, ROBOTS, SEED = Path(__file__).with_name("worlds.jsonl"), 30, 2  # draws that nothing was tuned on
FLIPS, FLIP_ROBOTS, FLIP_SEED = Path(__file__).with_name("flips.jsonl"), 200, 11
WORLDS = {
    "shove of 15 N s in flight": Ranges.none(shove_flight_n_s=(15.0, 15.0)),
    "ground of the landing ±3 cm, ±3 degrees": Ranges.none(ground_m=0.03, ground_tilt_deg=3.0),
    "twice the usual ranges": Ranges(
        mass=0.10,
        com_m=0.03,
        inertia=0.20,
        friction=(0.3, 1.0),  # the least there is
        delay_s=(0.0, 0.008),
        motor_gain=0.10,
    ),
    "the usual ranges": Ranges(),
}
# robots that jump re-aimed there; the first ROBOTS of them also plain
MANY = {"twice the usual ranges": 250, "shove of 15 N s in flight": 100}

DRAWN = Path(__file__).with_name("drawn.jsonl")
# per robot: plans, and from how far to how far, how high, how far aside [m] and turned [rad] they go, onto what [m]
HUMANOIDS = {
    "bhr": (36, (0.2, 1.1), (0.25, 0.5), 0.3, 0.8, (-0.15, 0.2)),
    "g1_arms": (20, (0.1, 0.5), (0.12, 0.25), 0.12, 0.5, (-0.1, 0.1)),
    "g1_legs": (4, (0.1, 0.4), (0.12, 0.2), 0.0, 0.0, (-0.1, 0.1)),
}
KINDS = "flat", "platform", "side", "turn", "gravity"
MOTORS = dict(rotor_kg_m2=(0.02, 0.02), damping_n_m_s=(1.0, 1.0))
USUAL = dict(engine="mujoco", contact="usual")
# world -> engine and contact, and how the robot differs
PLAYED = {
    "MuJoCo, usual": (USUAL, {}),
    "MuJoCo, hard": (dict(engine="mujoco"), {}),
    "MuJoCo, usual, friction 0.4": (USUAL, dict(friction=(0.4, 0.4))),
    "MuJoCo, usual, unknown rotors and damping": (USUAL, MOTORS),
    "PyBullet, hard": (dict(engine="bullet"), {}),
    "PyBullet, usual": (dict(engine="bullet", contact="usual"), {}),
}
WAYS = {"open loop": {}, "feedback": dict(feedback=True)}

# what a fall of the default jump begins with: the robot's seed, and the disturbances that it meets at their limits
FALLS = {
    "slip": (0, "friction+ground_tilt_deg+payload_kg"),
    "over-rotation": (0, "shove_flight_n_s"),
    "torque": (3, "torque_loss+speed_loss+payload_kg"),
}


def falls(tape: Tape, robot: Robot, scene: Scene, causes: Iterable[str] = FALLS) -> dict[str, SimulationResult]:
    """The falls that :data:`FALLS` has for the ``causes``, without re-aim."""
    found = {}
    for cause in causes:
        seed, names = FALLS[cause]
        drawn = Perturbation.draw(robot, seed, ranges_at(names, 1.0))
        found[cause] = simulate_jump(tape, robot, scene=scene, perturbation=drawn, reaim=False)
    return found


def study(folder: str | Path, path: Path = LOG, *, jobs: int | None = None) -> None:
    """Let robots jump the plan in ``folder`` in every world and engine; one row each, written after every series.

    Trials in the folder's log are not simulated again. ``python -m paper.worlds DIR [JOBS]`` calls it.
    """
    rows = []
    for world, engine, reaim in product(WORLDS, ENGINES, (True, False)):
        settings = TrialSettings(ranges=WORLDS[world], engine=engine, reaim=reaim)
        robots = MANY.get(world, ROBOTS) if reaim else ROBOTS
        for trial in run_trials(folder, robots, SEED, settings, jobs=jobs).trials:
            row = {"world": world, "engine": engine, "re-aim": reaim, "number": trial.key.index, "landed": trial.landed}
            rows.append(row | ({} if trial.landed else {"cause": trial.cause}))
        logs.write(path, rows, folder=folder)


def flips(folder: str | Path, path: Path = FLIPS, *, jobs: int | None = None) -> None:
    """Let perturbed robots of the usual ranges do the flip in ``folder``, re-aimed, in every engine; one row each.

    ``python -m paper.worlds --flips DIR`` calls it, for the plan of ``jumplab plan --robust --rotation-deg -360
    --distance-m 0 --height-m 0.5 --out DIR``.
    """
    rows = []
    for engine in ENGINES:
        for trial in run_trials(folder, FLIP_ROBOTS, FLIP_SEED, TrialSettings(engine=engine), jobs=jobs).trials:
            row = {"engine": engine, "number": trial.key.index, "landed": trial.landed}
            rows.append(row | ({} if trial.landed else {"cause": trial.cause}))
    logs.write(path, rows, folder=folder)


def drawn(seed: int = 41) -> dict[str, tuple[str, jl.JumpTask]]:
    """Targets by name, with their robot: of each kind as many, the same ones whenever they are drawn."""
    rng = np.random.default_rng(seed)
    cases = {}
    for robot, (count, far, high, side_m, yaw_rad, tops_m) in HUMANOIDS.items():
        for k in range(count):
            kind = KINDS[k % len(KINDS) if side_m else (0, 1, 4)[k % 3]]
            place = [rng.uniform(*x) for x in (far, high)]
            asked = dict(zip(("distance_m", "height_m"), place, strict=True))
            side, yaw = rng.uniform(-1, 1, 2) * [side_m, yaw_rad]
            top, gravity = rng.uniform(*tops_m), rng.uniform(6.0, 11.0)
            if kind in ("side", "turn"):
                asked |= {"distance_m": place[0] / 2, "side_m": side} | ({"yaw_rad": yaw} if kind == "turn" else {})
            if kind == "platform":
                asked |= {"distance_m": max(place[0], 0.3), "platform_m": top, "height_m": place[1] + max(top, 0.0)}
            if kind == "gravity":
                asked |= {"gravity": gravity}
            cases[f"{robot} {k} {kind}"] = robot, jl.JumpTask(**{name: round(x, 2) for name, x in asked.items()})
    return cases


def contacts(folder: str | Path, path: Path = DRAWN, *, jobs: int | None = None) -> None:
    """Play the :func:`drawn` plans in every world of :data:`PLAYED` and each way; a row each, written at once.

    Rows of the log are not made again; plans are kept in ``folder``. ``python -m paper.worlds --contacts DIR [JOBS]``
    calls it.
    """
    cases = drawn()
    with logs.keep(path, itemgetter("world", "case", "way")) as log:
        left = {key: [way for way in WAYS if (*key, way) not in log.done] for key in product(PLAYED, cases)}
        work = [joblib.delayed(_play)(Path(folder), *key, *cases[key[1]], ways) for key, ways in left.items() if ways]
        for row in chain.from_iterable(in_parallel(work, jobs, "generator")):
            log.add(row)


def _play(folder: Path, world: str, case: str, robot: str, task: jl.JumpTask, ways: list[str]) -> list[dict[str, Any]]:
    """Playbacks of one plan, see :func:`_played`; or why there is no plan."""
    place = folder / case
    rows = [{"world": world, "case": case, "way": way} for way in ways]
    try:
        if not (place / "plan.npz").is_file():
            jl.save(place, jl.plan(task, robot))
        plan = jl.load(place).plan
    except SolverError as e:
        return [row | {"refusal": str(e)} for row in rows]
    return [row | _played(plan, world, row["way"]) for row in rows]


def _played(plan: jl.JumpPlan, world: str, way: str) -> dict[str, Any]:
    """Whether it stands, and by how much the place of the feet, the CoM's apex and rise, and the trunk's tilt at
    touchdown differ from the plan's.
    """
    options, ranges = PLAYED[world]
    differs = Perturbation.draw(plan.robot, SEED, Ranges.none(**ranges)) if ranges else None
    run = jl.simulate(plan, perturbation=differs, **options, **WAYS[way])
    m, tape = run.metrics, plan.tape
    row = {"stands": run.landed, "reason": run.reason}
    row["failed_checks"] = [check.name for check in run.checks if not check.passed]
    if None not in (m.foot_distance_m, m.com_rise_m, m.touchdown_s):
        off = m.foot_distance_m - plan.planned_distance_m, m.side_m - plan.planned_side_m
        row |= {"short_m": -off[0], "miss_m": float(np.hypot(*off))}
        row |= {"apex_m": m.com_apex_m - plan.planned_apex_m, "rise_m": m.com_rise_m - plan.planned_rise_m}
        ends = run.q[round(m.touchdown_s / STEP_S)], tape.q[tape.flights[-1].stop - 1]
        turned = np.subtract(*(rotation(q[3:7])[2] for q in ends))  # of the vertical, in the trunk's axes
        row["tilt_deg"] = float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(turned) / 2))))
    return {key: round(x, 5) if isinstance(x, float) else x for key, x in row.items()}


def outcomes(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per world and way: how many drawn plans stand, with Wilson's 95 % interval, and what half and 95 % of
    those that stand stay below.
    """
    lines = []
    for world, way in product(PLAYED, WAYS):
        here = [r for r in rows if (r["world"], r["way"]) == (world, way) and "stands" in r]
        if not here:
            continue
        stand = [r for r in here if r["stands"]]
        low, high = wilson(len(stand), len(here))
        line = {"world": world, "way": way, "plans": len(here), "stand": len(stand)}
        line |= {"from [%]": 100 * low, "to [%]": 100 * high}
        for name, key, unit in (("miss", "miss_m", "cm"), ("apex", "apex_m", "cm"), ("tilt", "tilt_deg", "deg")):
            size = np.abs([r[key] for r in stand]) * (100 if unit == "cm" else 1)
            half, most = np.quantile(size, [0.5, 0.95]).tolist() if len(size) else (None, None)
            line |= {f"{name}, half [{unit}]": half, f"{name}, 95 % [{unit}]": most}
        lines.append(line)
    return lines


def stored(path: Path = LOG) -> list[dict[str, Any]]:
    """The kept rows."""
    return logs.rows(path)


def margins() -> dict[str, dict[str, MarginReport]]:
    """The kept margins of the default jump by engine and way: "usual", "robust", "one step", "feedback"."""
    found = logs.table(Path(__file__).with_name("margins.json"))
    return {engine: {way: MarginReport.from_json(x) for way, x in told.items()} for engine, told in found.items()}


def side_by_side(ways: dict[str, MarginReport]) -> list[dict[str, Any]]:
    """A line per disturbance: the largest size that each way tolerates; empty where it was not tried."""
    found = {
        (m.names, f"{way}, {'re-aimed' if m.reaim else 'plain'}"): m.row()["tolerates"]
        for way, told in ways.items()
        for m in told.margins
    }
    names, columns = (list(dict.fromkeys(x)) for x in zip(*found, strict=True))
    return [{"disturbance": name} | {c: found.get((name, c), "") for c in columns} for name in names]


def in_words(disturbance: str) -> str:
    """A disturbance, or a pair "A+B", each with the largest size that is tried."""
    limits = {f.name: f.metadata for f in fields(Ranges)}
    parts = []
    for name in disturbance.split("+"):
        unit = limits[name]["unit"] or "times" * (name == "sensors")
        size = limits[name]["most"] * {"%": 100, "m": 1000}.get(unit[:1] if unit != "kg m^2" else "", 1)
        word = re.sub(r"_(kg|m|s|n_s|deg)$", "", name).replace("_", " ").replace("com", "links' CoM")
        parts.append(f"{word} {size:g} {unit.split(' per')[0].removesuffix(' late')}".rstrip())
    return " + ".join(parts)


def moved(usual: MarginReport, other: MarginReport) -> list[dict[str, Any]]:
    """A line per disturbance that both know and one of them does not tolerate to its limit: how far the margin moved.

    Shares count from nothing to the limit; from a margin of nothing no gain is told.
    """
    known, rows = {(m.names, m.reaim): m.share for m in other.margins}, []
    for m in usual.margins:
        share = known.get((m.names, m.reaim))
        if share is None or m.share == share == 1:
            continue
        gain = 100 * (share / m.share - 1) if m.share else None
        rows.append({"disturbance": m.names, "re-aim": m.reaim, "usual": m.share, "other": share, "gain [%]": gain})
    return rows


def shares(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line per world and engine in which robots jumped re-aimed, and the same ones or some of them plain.

    It has the number that land of each, Wilson's 95 % interval of the re-aimed, and the causes of their falls.
    """
    table = []
    for world, engine in dict.fromkeys((r["world"], r["engine"]) for r in rows):
        aimed, plain = (
            {r["number"]: r for r in rows if (r["world"], r["engine"], r["re-aim"]) == (world, engine, on)}
            for on in (True, False)
        )
        if not plain or not plain.keys() <= aimed.keys():
            continue
        line = {"world": world, "engine": engine, "robots": len(aimed)}
        landed = sum(r["landed"] for r in plain.values())
        line |= {"plain": f"{landed} of {len(plain)}", "plain [%]": 100 * landed / len(plain)}
        table.append(line | share(list(aimed.values())))
    return table


def counts() -> list[str]:
    """Rows of the page on validity: perturbed robots that stand in PyBullet and in MuJoCo, as the files have them.

    ``python -m paper.worlds --counts`` prints them.
    """
    lines, kept, flown = [], stored(), stored(FLIPS)
    many = {engine: runs.stored(engine, "delay_s") for engine in ENGINES}

    def row(jump: str, path: Path, landed: Iterable[list[bool]], off: str = "") -> None:
        shares = " | ".join(f"{sum(here)} of {len(here)}" for here in landed)
        lines.append(f'| {jump} | "{runs.origin(path)[0]}" | {shares} | {off} |')

    far_m = [t.foot_distance_m - 1.0 for here in many.values() for t in here if t.landed]
    off = f"{100 * np.std(far_m):.0f} cm, {100 * np.abs(far_m).max():.0f} cm"
    row("default jump, the usual ranges, re-aimed", runs.LOG, ([t.landed for t in x] for x in many.values()), off)
    for world, aimed in product(reversed(WORLDS), (True, False)):
        if not (aimed and world == "the usual ranges"):  # more of these stand above
            mine = [r for r in kept if (r["world"], r["re-aim"]) == (world, aimed)]
            found = ([r["landed"] for r in mine if r["engine"] == engine] for engine in ENGINES)
            row(f"default jump, {world}, {'re-aimed' if aimed else 'played plainly'}", LOG, found)
    found = ([r["landed"] for r in flown if r["engine"] == engine] for engine in ENGINES)
    row("backflip of 0.5 m, robust plan, the usual ranges, re-aimed", FLIPS, found)
    return lines


def contact_counts() -> list[str]:
    """Rows of the page on validity: the drawn plans on MuJoCo's default contacts, and the largest misses of those that
    stand.

    ``python -m paper.worlds --counts`` prints them, too.
    """
    kept = [r for r in logs.rows(DRAWN) if r["world"] == "MuJoCo, usual" and "stands" in r]
    lines = []
    for jumps, aside, robots in (
        ("straight ahead, all robots", False, tuple(HUMANOIDS)),
        ("to the side and with turns, `bhr`", True, ("bhr",)),
        ("to the side and with turns, `g1_arms`", True, ("g1_arms",)),
    ):
        cells = []
        for way in WAYS:
            names = [(r, *r["case"].split()) for r in kept if r["way"] == way]
            here = [r for r, robot, _, kind in names if robot in robots and (kind in ("side", "turn")) == aside]
            stand = [r for r in here if r["stands"]]
            miss_m, apex_m, tilt_deg = (max(abs(r[key]) for r in stand) for key in ("miss_m", "apex_m", "tilt_deg"))
            off = f"{100 * miss_m:.0f} cm, {100 * apex_m:.0f} cm, {tilt_deg:.0f}°"
            cells += [f"{len(stand)} of {len(here)}", off]
        lines.append(f"| {jumps} | {' | '.join(cells)} |")
    return lines


def share(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Number of the re-aimed robots of ``rows`` that land, with Wilson's 95 % interval, and the causes of the falls."""
    landed = sum(r["landed"] for r in rows)
    low, high = wilson(landed, len(rows))
    causes = Counter(r["cause"] for r in rows if not r["landed"]).most_common()
    line = {"re-aimed": landed, "re-aimed [%]": 100 * landed / len(rows), "from [%]": 100 * low, "to [%]": 100 * high}
    return line | {"falls of the re-aimed": ", ".join(f"{cause} {n}" for cause, n in causes)}


if __name__ == "__main__":
    if sys.argv[1] == "--counts":
        sys.exit(print(*counts(), *contact_counts(), sep="\n"))
    made = {"--flips": flips, "--contacts": contacts}.get(sys.argv[1], study)
    rest = sys.argv[1 + (made is not study) :]
    made(rest[0], jobs=int(rest[1]) if len(rest) > 1 else None)
