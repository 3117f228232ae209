"""Harder worlds: how many perturbed robots land in each, with the legs re-aimed in the air and without."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import ENGINES, Perturbation, Ranges, Scene, SimulationResult, simulate_jump
from jumplab.studies.margins import MarginReport, ranges_at
from jumplab.studies.trials import TrialSettings, run_trials, wilson
from paper import logs

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

    What the folder's log has is not simulated again. ``python -m paper.worlds DIR [JOBS]`` calls it.
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


def moved(usual: MarginReport, other: MarginReport) -> list[dict[str, Any]]:
    """A line per disturbance that both know and one of them does not bear to its limit: how far the margin moved.

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

    It tells how many land of each, Wilson's 95 % interval of the re-aimed, and the causes of their falls.
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


def share(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How many of the re-aimed robots of ``rows`` land, with Wilson's 95 % interval, and what the falls begin with."""
    landed = sum(r["landed"] for r in rows)
    low, high = wilson(landed, len(rows))
    causes = Counter(r["cause"] for r in rows if not r["landed"]).most_common()
    line = {"re-aimed": landed, "re-aimed [%]": 100 * landed / len(rows), "from [%]": 100 * low, "to [%]": 100 * high}
    return line | {"falls of the re-aimed": ", ".join(f"{cause} {n}" for cause, n in causes)}


if __name__ == "__main__":
    made, rest = (flips, sys.argv[2:]) if sys.argv[1] == "--flips" else (study, sys.argv[1:])
    made(rest[0], jobs=int(rest[1]) if len(rest) > 1 else None)
