"""The claims' verdicts, the measurements behind them against a second way, and the gathered table of readings."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, planner, refused
from paper import capture, claims, hard_cases, worlds
from paper.claims import CLAIMS, Start, against_crouch, compare_starts, judge, readings, readings_markdown
from paper.tracking import followed_table, launch_followed, tracking

from jumplab.cli import notebooks
from jumplab.errors import InputError
from jumplab.models.full import FullBody
from jumplab.sim import STEP_S
from jumplab.stages.planner import METHODS
from jumplab.task import GRAVITY, JumpTask

# ------------------------------------------------------------------------------------------ verdicts


@pytest.mark.parametrize(
    ("name", "value", "change", "verdict"),
    [
        ("time", 2.0, "", "holds"),
        ("time", np.float64(2), "half of it", "holds with a change"),
        ("time", 10.1, "", "does not hold"),
        ("time", 10.1, "half of it", "does not hold"),
        ("time", np.nan, "", "does not hold"),
        ("wrenches", 12, "half of it", "adopted: ours by construction"),
        ("wrenches", 6, "", "does not hold"),
        ("hardware", None, "", "open: cannot be checked here"),
    ],
)
def test_verdict_follows_the_measurement(name, value, change, verdict):
    claim = CLAIMS[name]
    row = judge(name, "1.0 m", dict.fromkeys(claim.limits or (), value), change)
    assert row == {"claim": claim.sentence, "verdict": verdict, "holds if": claim.words, "measured": "1.0 m",
                   "change": change, "where": claim.where}  # fmt: skip


def test_limits_in_words():
    assert CLAIMS["jumps"].words == ("toe to toe [m] ≥ 1; CoM up on the platform [m] 0.48 … 0.52; jumps that stand = 2")
    assert CLAIMS["shapes"].words.startswith(
        "least rho of that at lift-off ≤ 0.95; change by the legs [kg m²] ≤ -0.01;"
    )
    assert CLAIMS["hardware"].words == "none"


# of each claim the values that just keep its limits, and one by one those that just do not
EDGES = {
    "jumps": [(1.0, 0.999), (0.48, 0.479), (2, 1)],
    "time": [(10.0, 10.01)],
    "chain": [(3, 2), (4, 5), (20, 19), (7, 8)],
    "size": [(1.45, 1.449), (42.5, 42.51), (14, 13)],
    "links": [(9, 8), (20, 19), (2, 1), (6, 5), (2, 1), (4, 3)],
    "five links": [(1e-9, 1.01e-9)],
    "wrenches": [(12, 11)],
    "gravity": [(9.8, 9.79), (9.8, 9.81)],
    "ballistics": [(0.03, 0.0301), (0.05, 0.0501)],
    "sensors": [(1, 1.001), (250, 250.1), (8, 8.01)],
    "open loop": [(1, 0), (0, 1), (1, 0), (0, 1)],
    "differs": [(20, 19), (50, 50.1), (0.9, 0.89)],
    "bias": [(20, 19), (0.9, 0.89)],
    "guess": [(24, 23), (0.95, 0.951), (0.95, 0.951)],
    "tracks": [(0.1, 0.101)],
    "bows": [(3.0, 2.99), (3.0, 2.99)],
    "shapes": [(0.95, 0.951), (-0.01, 0), (-0.01, 0), (0.01, 0)],
    "vibrates": [(3, 2), (0, 1), (0.05, 0.0501)],
    "flip": [(0.3, 0.301)],
    "posture": [(20.0, 19.9), (0, 1), (0, 1)],
}
OTHER_ENDS = {"jumps": [(1, 0.521)], "size": [(0, 1.551), (1, 41.49)], "differs": [(1, 0.99)]}


@pytest.mark.parametrize("name", [name for name, claim in CLAIMS.items() if claim.limits])
def test_each_limit_decides(name):
    """A value that just keeps all limits holds; with any one of them just beyond, the claim does not."""
    names = list(CLAIMS[name].limits)
    kept = [inside for inside, _ in EDGES[name]]
    assert judge(name, "1", dict(zip(names, kept, strict=True)))["verdict"] != "does not hold"
    beyond = [*enumerate(outside for _, outside in EDGES[name]), *OTHER_ENDS.get(name, ())]
    for k, value in beyond:
        values = dict(zip(names, [*kept[:k], value, *kept[k + 1 :]], strict=True))
        assert judge(name, "1", values)["verdict"] == "does not hold", values


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("it jumps", "1 m"), "there is no claim 'it jumps'; choose from jumps, time, chain, size,"),
        (("time", " ", {"slowest plan [CPU s]": 1}), "measured of a claim must be a text, got ' '"),
        (("time", 1.0), "measured of a claim must be a text, got 1.0"),
        (("time", "1 s"), "claim 'time': measured are no values; it needs slowest plan [CPU s] ≤ 10"),
        (("time", "1 s", {"s": 1}), "claim 'time': measured are s; it needs slowest plan [CPU s] ≤ 10"),
    ],
)
def test_a_verdict_without_numbers_is_refused(arguments, sentence):
    assert refused(judge, *arguments).startswith(sentence)


# ------------------------------------------------------------------------------------------ measurements


def test_standing_height(bhr):
    assert claims.standing_height_m(bhr) == pytest.approx(1.5, abs=1e-9)
    assert "the robot must be a Robot, got 'bhr'" in refused(claims.standing_height_m, "bhr")


def test_five_links_are_nine(bhr):
    differ = claims.five_against_nine(bhr, samples=5, seed=3)
    assert set(differ) == {"mass [kg]", "CoM [m]", "L [kg m^2/s]", "rho [kg m^2]"}
    assert max(differ.values()) < 1e-9, differ


def test_what_five_links_miss_is_told(bhr, monkeypatch):
    def off(*given):
        found = claims_planar(*given)
        return found | {"com": found["com"] + [2e-3, -3e-3], "L": found["L"] - 0.5, "rho": found["rho"] + 0.25}

    claims_planar = claims.planar_quantities
    monkeypatch.setattr(claims, "planar_quantities", off)
    differ = claims.five_against_nine(bhr, samples=3, seed=3)
    assert [differ[k] for k in ("CoM [m]", "L [kg m^2/s]", "rho [kg m^2]")] == pytest.approx([3e-3, 0.5, 0.25])


def test_starts_are_compared_with_the_crouch():
    """Medians of shares, worked out by hand; a target that the crouch fails does not count."""
    a, b, c = (JumpTask(x, 0.3) for x in (0.2, 0.4, 0.6))
    rows = [
        Start(a, "crouch", 40, 2.0, 2.0, 1.0), Start(a, "stage 2", 20, 1.0, 1.5, 1.0),
        Start(b, "crouch", 10, 1.0, 1.0, 1.0), Start(b, "stage 2", 10, 0.5, 1.0, 1.0),
        Start(c, "crouch"), Start(c, "stage 2", 5, 0.1, 0.1, 1.0),
    ]  # fmt: skip
    crouch, guess = against_crouch(rows)
    assert (crouch["solved"], guess["solved"], guess["targets"]) == (2, 3, 3)
    assert [crouch[k] for k in crouch if "share" in k] == [1.0, 1.0, 1.0]
    assert guess["iterations, share"] == pytest.approx(0.75)
    assert guess["stage 3 alone, share"] == pytest.approx(0.5)
    assert guess["with the guess, share"] == pytest.approx(0.875)
    assert against_crouch(rows[-2:])[1]["iterations, share"] is None


def test_costlier_jumps_are_told():
    """More than a hundredth above the least cost found for a target, from whatever start."""
    tasks = [JumpTask(x, 0.3) for x in (0.2, 0.4, 0.6)]
    costs = [(1.0, 1.009, 1.0), (1.011, 1.0, 1.2), (2.0, 2.5, 2.0)]
    rows = [
        Start(task, name, 10, 1.0, 1.0, cost)
        for task, found in zip(tasks, costs, strict=True)
        for name, cost in zip(claims.STARTS, found, strict=True)
    ]
    found = against_crouch(rows)
    assert [row["costlier"] for row in found] == [1, 1, 1]
    assert [row["by at most [%]"] for row in found] == pytest.approx([1.1, 25.0, 20.0])


@pytest.mark.slow
def test_three_starts_end_in_a_jump(bhr):
    """Stage 2's start ends in the very jump that the planner makes; slow jumps have several solutions."""
    rows = compare_starts([JumpTask(0.5, 0.3)], bhr)
    assert [r.start for r in rows] == list(claims.STARTS)
    assert all(r.iterations > 0 and 0 < r.alone_s <= r.total_s for r in rows), rows
    crouch, guess, loose = rows
    assert loose.total_s > loose.alone_s and guess.total_s > guess.alone_s
    planned = jump(0.5, 0.3).whole_body.solution.statistics
    assert guess.cost == pytest.approx(planned.objective, rel=1e-6)
    assert loose.cost == pytest.approx(crouch.cost, rel=0.05)


# ------------------------------------------------------------------------------------------ readings


def write(path, *sources):
    path.write_text(json.dumps({"cells": [{"cell_type": "markdown", "source": s} for s in sources]}))
    return path


HEAD = "## Differences from the paper\n\n| the paper says | we do | because | effect |\n|---|---|---|---|\n"


def test_readings_are_gathered_in_order(tmp_path):
    first = write(
        tmp_path / "00_a.ipynb", "# Title\n\n| a | b |\n|---|---|\n| 1 | 2 |", HEAD + "| x | y | z | |\n\n## Versions"
    )
    second = write(tmp_path / "01_b.ipynb", f"text\n\n{HEAD}| $\\|A\\|$ | b | c | d |\n| e | f | g | h |")
    none = write(tmp_path / "02_c.ipynb", "# nothing here")
    rows = readings([first, str(second), none])
    assert [tuple(r.values()) for r in rows] == [
        ("00_a", "x", "y", "z", ""),
        ("01_b", r"$\|A\|$", "b", "c", "d"),
        ("01_b", "e", "f", "g", "h"),
    ]
    lines = readings_markdown(rows).splitlines()
    assert lines[:2] == ["| notebook | the paper says | we do | because | effect |", "|---|---|---|---|---|"]
    assert lines[3] == r"| [01_b](01_b.ipynb) | $\|A\|$ | b | c | d |"


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        (HEAD + "| a | b | c |", "00_a.ipynb: the row '| a | b | c |' of its differences from the paper has 3 columns"),
        (
            HEAD.replace("effect", "so"),
            "00_a.ipynb: its differences from the paper have the columns the paper says, we do, because, so;",
        ),
    ],
)
def test_broken_tables_are_named(tmp_path, source, sentence):
    assert refused(readings, [write(tmp_path / "00_a.ipynb", source)]).startswith(sentence)


def test_unreadable_notebooks_are_named(tmp_path):
    broken = tmp_path / "00_a.ipynb"
    broken.write_text("{")
    for path in (broken, tmp_path / "01_none.ipynb"):
        with pytest.raises(InputError, match=rf"{path.name}: not a readable notebook"):
            readings([path])


def test_every_notebook_of_the_package_has_its_table():
    found = notebooks.find_notebooks()
    rows = readings(found)
    assert {r["notebook"] for r in rows} == {p.stem for p in found}
    assert all(r["the paper says"] and r["we do"] for r in rows)


def test_every_id_that_differs_is_in_a_table():
    """Terms of the stages whose equation is a printed one with a remark, and printed ones that none of them has."""
    ids = re.compile(r"[A-Z]{2}-[A-Z]\d?")
    terms = (Path(__file__).parent / "terms.txt").read_text(encoding="utf-8").splitlines()
    own = {
        line.split(" | ")[2] for line in terms if line.startswith(("SRMP/", "whole body/")) and line.count(" | ") > 2
    }
    kept = {x for equation in own for x in ids.findall(equation)}
    changed = {x for equation in own if re.sub(r"[\s,]", "", ids.sub("", equation)) for x in ids.findall(equation)}
    assert len(changed) > 10 and changed < kept
    unlike = {"SF-B1", "SF-S", "JF-R1", "WL-J1", "WL-J2", "WF-J2", "WL-K2"}  # boxes, blends, shares, inputs, a place
    stage_2 = {f"{stage}-C{k}" for stage, last in (("JL", 4), ("JF", 3)) for k in range(1, last + 1)}
    said = {x for row in readings(notebooks.find_notebooks()) for x in ids.findall(row["the paper says"])}
    assert (changed | unlike | stage_2) <= said, sorted((changed | unlike | stage_2) - said)


# ------------------------------------------------------------------------------------------ what flights and trunks do


def test_a_trunk_that_falls_feels_nothing_and_one_that_stands_feels_one_g(bhr):
    n = 5
    t, rest = np.arange(n) * STEP_S, np.tile(pin.neutral(bhr.model), (n, 1))
    falling = np.zeros((n, bhr.model.nv))
    falling[:, 2] = -GRAVITY * t
    assert claims.trunk_feels(SimpleNamespace(q=rest, v=falling), bhr) == pytest.approx(np.zeros(n - 1), abs=1e-9)
    assert claims.trunk_feels(SimpleNamespace(q=rest, v=0 * falling), bhr) == pytest.approx(np.ones(n - 1))
    whirling = np.zeros((n, bhr.model.nv))
    whirling[:, 4] = 100.0 * t  # at constant angular acceleration, and nearly no speed: lever times 100 rad/s^2
    lever = bhr.model.inertias[1].lever
    felt = np.hypot(100.0 * lever[2] / GRAVITY, 1.0 - 100.0 * lever[0] / GRAVITY)
    assert claims.trunk_feels(SimpleNamespace(q=rest, v=whirling), bhr)[0] == pytest.approx(felt, rel=1e-6)


def test_what_is_drawn_in_counts_for_the_limbs_that_move(bhr):
    """A flight whose knees fold, and whose arms stay: the inertia falls by the legs alone."""
    body, q = FullBody(bhr), np.tile(pin.neutral(bhr.model), (11, 1))
    for name in ("left_knee", "right_knee"):
        q[:, 7 + bhr.joint_names.index(name)] = np.linspace(0.0, 1.5, 11)
    rho = np.array([body.terms(x, np.zeros(body.nv)).rho for x in q])
    run = SimpleNamespace(t=np.arange(11.0), q=q, rho=rho, metrics=SimpleNamespace(liftoff_s=2.0, touchdown_s=9.0))
    found = claims.drawn_in(run, bhr)
    assert found["lift-off"] == found["greatest"] == rho[2] and found["least"] == found["touchdown"] == rho[8]
    assert found["arms"] == 0 and found["legs"] == pytest.approx(rho[8] - rho[2])


def launched(error):
    """A run of 0.5 s until lift-off whose L is a plan's with peak -4, and an ``error`` over the time besides."""
    t = np.arange(0.0, 0.7, STEP_S)
    planned = -4.0 * t / t[-1]
    tape = SimpleNamespace(t=t, extra={"planar_L": planned})
    run = SimpleNamespace(t=t, L=planned + error(t), metrics=SimpleNamespace(liftoff_s=0.5))
    return run, tape


def test_momentum_is_compared_in_the_first_tenth_of_a_second_and_after():
    """By shares of the planned peak; what comes after lift-off does not count."""
    error = np.array([0.4, -0.08, 4.0])
    found = claims.momentum_error(*launched(lambda t: error[np.searchsorted([0.0995, 0.4995], t)]))
    assert found == pytest.approx((0.1, 0.02), rel=1e-9)


@pytest.mark.parametrize(
    ("error", "swings"),
    [
        (lambda t: 0.0 * t, (0, 0)),
        (lambda t: 0.3 * t, (0, 0)),  # a drift
        (lambda t: 0.2 * (np.abs(t - 0.03) < 0.0015), (2, 0)),  # one blow
        (lambda t: 0.1 * np.sin(2 * np.pi * 50 * t) * (t < 0.08), (8, 0)),  # four periods of 50 Hz
        (lambda t: 0.1 * np.sin(2 * np.pi * 50 * t) * (t > 0.2) * (t < 0.3), (0, 10)),
        (lambda t: 0.1 * np.sin(2 * np.pi * 50 * t) * (t > 0.46), (0, 0)),  # the plan is fast there itself
        (lambda t: 0.035 * np.sin(2 * np.pi * 50 * t) * (t < 0.08), (8, 0)),  # swings by 1.75 % of the peak
        (lambda t: 0.015 * np.sin(2 * np.pi * 50 * t), (0, 0)),  # less than a hundredth of the peak
    ],
)
def test_a_vibration_swings_to_and_fro(error, swings):
    assert claims.vibration(*launched(error)) == pytest.approx(swings, abs=1 if max(swings) > 2 else 0)


def test_swings_by_hand():
    assert claims.swings(np.array([0, 1, 0, 1, 0.5, 1.2, -1]), 0.9) == 4
    assert claims.swings(np.array([0, 0.4, 0.8, 1.2]), 0.9) == 1
    assert claims.swings(np.zeros(5), 0.1) == 0


def test_the_bow_is_where_the_push_begins():
    """In degrees, from the first sample to where the CoM falls fastest before it rises fastest."""
    rate = np.array([0.0, -0.5, -1.0, -0.2, 1.0, 3.0, -9.0])
    pitch = np.array([0.1, 0.2, 0.1 + np.pi / 6, 0.9, 0.9, 0.9, 0.9])
    assert claims.bow_deg(pitch, rate) == pytest.approx(30.0)


def test_a_mean_over_twenty_milliseconds():
    blow = np.zeros(100)
    blow[40:50] = 1.0
    assert claims.steady(blow).max() == pytest.approx(0.5) and len(claims.steady(blow)) == 81


def test_tracking_by_hand(monkeypatch, bhr):
    """Stage 2 against stage 1 at four nodes, two of them in the launch."""
    zero, two = np.zeros(4), np.zeros((4, 2))
    wanted = {"com": two, "com_velocity": np.add(two, [3, 4]), "L": np.array([0.0, -2, 9, 9]), "foot_com": two[2:],
              "rho": zero + 4.0}  # fmt: skip
    off = {"com": np.array([[0.3, 0.4], [0, 0], [9, 9], [9, 9]]), "com_velocity": np.add(two, [0.06, 0.08]),
           "L": np.array([0.5, -0.2, 9, 9]), "rho": np.array([0.4, 0.4, 0.8, 0.8]),
           "foot_com": np.array([[0.06, 0.08], [0.0, 0.02]])}  # fmt: skip
    actual = {key: wanted[key] + off[key] for key in wanted}
    monkeypatch.setattr("paper.tracking.compared", lambda *_: (actual, wanted))
    found = tracking(SimpleNamespace(rows=lambda _: slice(0, 2)), None, bhr)
    assert found == pytest.approx(
        {
            "takeoff_velocity": 0.1 / 5.0,
            "takeoff_momentum": 0.1,
            "launch_momentum": 0.25,
            "launch_inertia_rms": 0.1,
            "flight_inertia_rms": 0.2,
            "launch_com": 0.5,
            "flight_foot_rms": np.sqrt((0.1**2 + 0.02**2) / 2),
            "touchdown_foot": 0.02,
        }
    )


def a_launch(monkeypatch, com_x=(0.0, 0.0, 0.0, 0.0), L=-1.5):
    """A jump of four instants of launch and two of flight: L asked -2 in launch, 7 in flight, peaks 5 in both."""
    n, k = 6, 4
    two = np.ones((n, 2))

    def asked(launch_t, flight_t):
        parts = (SimpleNamespace(L=np.full(len(t), L), com_velocity=two[: len(t)] * [0.0, 2.0], rho_rate=0.0 * t,
                                 rho=np.full(len(t), 4.0), com=two[: len(t)] * [0.3, 0.6])
                 for t, L in ((launch_t, -2.0), (flight_t, 7.0)))  # fmt: skip
        return SimpleNamespace(**dict(zip(("launch", "flight"), parts, strict=True)))

    column = {"L": np.full(n, L), "rho": np.full(n, 4.2), "com_velocity": two * [0.03, 2.04], "toe_phase_start": 0.2,
              "com": np.transpose([[*com_x, 9.0, 9.0], [0.5, 0.5, 0.5, 0.5, 9.0, 9.0]])}  # fmt: skip
    tape = SimpleNamespace(t=np.array([0, 0.1, 0.2, 0.3, 0.3, 0.6]), takeoff_index=k, takeoff_time=0.3,
                           extra={f"planar_{name}": x for name, x in column.items()})  # fmt: skip
    peaks = SimpleNamespace(L=np.array([0.0, -5.0, 1.0]), com_velocity=np.array([[0.0, 0.0], [3.0, 4.0]]))
    srmp = SimpleNamespace(launch_s=0.8, toe_s=0.1, flight_s=0.6, at=asked, launch=peaks)
    monkeypatch.setattr("paper.tracking._rho_rate", lambda plan: np.zeros(n))
    return SimpleNamespace(tape=tape, srmp=srmp)


def test_how_a_launch_is_followed_by_hand(monkeypatch):
    """Shares of the peaks of L and of the CoM's speed, and of the mean of the inertia; paths from where they start."""
    found = launch_followed(a_launch(monkeypatch, (0.1, 0.1, 0.13, 0.1)))
    assert found == pytest.approx({"L": 0.1, "velocity": 0.05 / 5.0, "rho": 0.05, "com": 0.03})


def test_a_launch_is_judged_by_its_worst_jump(monkeypatch):
    jumps = [a_launch(monkeypatch, (0.0, 0.0, way, 0.0), L) for way, L in ((0.0, -2.0), (0.02, -1.9), (0.04, -1.5))]
    rows = {row["unit"]: row for row in followed_table(jumps) if row["in the launch"] != "CoM velocity, rms"}
    spun, still, way = (rows[unit] for unit in ("% of its peak", "% of its mean", "cm"))
    assert (spun["median"], spun["worst"], spun["holds"]) == (pytest.approx(2.0), pytest.approx(10.0), "yes")
    assert (way["median"], way["worst"], way["holds"]) == (pytest.approx(2.0), pytest.approx(4.0), "does not hold")
    assert (spun["at most"], way["at most"], still["at most"], still["holds"]) == (10.0, 3.0, "", "")
    assert followed_table([a_launch(monkeypatch, L=-1.49)])[0]["holds"] == "does not hold"


def test_postures_at_touchdown_are_in_degrees(bhr, monkeypatch):
    """Of stage 2, stage 3 and the stance: four joints by the difference of their links, trunk and foot."""
    links = np.radians([5.0, 15.0, -30.0, 10.0, 40.0])  # foot, shank, thigh, trunk, arm
    monkeypatch.setattr("paper.claims.to_link_angles", lambda *_: ([None, links],))
    joints = SimpleNamespace(q=None, v=None, a=None)
    tape = SimpleNamespace(extra={"planar_angles": [None, 2 * links]})
    rows = claims.touchdown_postures(SimpleNamespace(robot=bhr, joints=joints, tape=tape))
    found = {row["what"]: row for row in rows}
    assert found["trunk"]["stage 2"] == pytest.approx(10.0) and found["foot"]["stage 3"] == pytest.approx(10.0)
    assert abs(found["knee"]["stage 2"]) == pytest.approx(45.0) and abs(found["hip"]["stage 3"]) == pytest.approx(80.0)


# ------------------------------------------------------------------------------------------ three steps against one


def test_the_stored_study_holds_every_case_in_both_ways():
    rows, asked = hard_cases.read(), hard_cases.cases()
    assert len(asked) == 240 and {case.kind for case in asked} == set(hard_cases.KINDS)
    assert [(r["number"], r["method"]) for r in rows] == [(c.number, m) for c in asked for m in METHODS]
    for case, row in zip(asked, rows[::2], strict=True):
        t = case.task
        assert (row["kind"], row["variant"]) == (case.kind, case.variant)
        assert (row["distance_m"], row["height_m"], row["platform_m"]) == (t.distance_m, t.height_m, t.platform_m)


def test_medians_of_a_study_by_hand(tmp_path):
    def row(number, method, cpu_s, effort, clean=True, kind="bad guesses"):
        where = {"kind": kind, "distance_m": 0.5, "height_m": 0.3, "clean": clean}
        return {"number": number, "method": method, "cpu_s": cpu_s, "effort": effort, **where}

    numbers = ((2.0, 30.0), (1.0, 10.0)), ((1.0, 20.0), (1.0, 10.05)), ((9.0, None, False), (1.0, 40.0))
    rows = [row(k, method, *x) for k, pair in enumerate(numbers) for method, x in zip(METHODS, pair, strict=True)]
    path = tmp_path / "log"
    path.write_text("\n".join(json.dumps(r) for r in reversed(rows)))
    assert hard_cases.read(path) == rows
    bad, every = hard_cases.compared(rows)[-2:]
    assert (bad["number"], bad["three-step, clean"], bad["direct, clean"]) == (3, 2, 3)
    assert (bad["cpu_s, ratio"], bad["effort, ratio"]) == (1.5, pytest.approx((3 + 20 / 10.05) / 2))
    assert (bad["three-step, same"], bad["direct, same"]) == (0.5, pytest.approx(2 / 3))
    assert every["cpu_s, ratio"] == 1.5 and every["direct, same"] is None


def test_a_stopped_study_goes_on(tmp_path, monkeypatch):
    asked, solved = hard_cases.cases()[:2], []

    def solve(case, method):
        solved.append((case.number, method))
        return {"number": case.number, "method": method}

    monkeypatch.setattr(hard_cases, "solve", solve)
    monkeypatch.setattr("paper.logs.code", lambda: {"sim/a.py": "0"})  # reading all sources takes seconds
    hard_cases.run(tmp_path / "log", asked[:1])
    rows = hard_cases.run(tmp_path / "log", asked)
    assert solved == [(0, "three-step"), (0, "direct"), (1, "three-step"), (1, "direct")]
    assert [tuple(r.values()) for r in rows] == solved


@pytest.mark.slow
def test_a_case_is_solved_in_both_ways():
    """The direct one from a guess with much noise: the feet are put in place, or neither Hessian leads anywhere."""
    noisy = hard_cases.cases()[95]
    assert noisy.kind == "bad guesses" and hard_cases.NOISE_RAD[noisy.variant // 5 % 4] == 0.8
    cases = {"three-step": hard_cases.Case(0, "bad guesses", JumpTask(0.5, 0.3), 3), "direct": noisy}
    for method in METHODS:
        row = hard_cases.solve(cases[method], method)
        assert row["planned"] and row["clean"] and row["effort"] > 0 and row["cpu_s"] > 0, row


@pytest.mark.slow
def test_the_jump_follows_stage_one():
    """In the launch, rms over the time, at the same share of each phase, as the page on validity says."""
    for target in ((0.0, 0.2), (0.4, 0.5), (1.0, 0.5)):
        followed = launch_followed(jump(*target))
        assert followed["L"] < 0.08 and followed["velocity"] < 0.05 and followed["rho"] < 0.02
    loose = planner().plan(JumpTask(*target), "three-step", weights={"track momentum": 0.02})
    assert launch_followed(loose)["L"] > 4 * followed["L"]


@pytest.mark.slow
def test_what_following_costs_and_where_it_ends():
    """The CoM leaves its path by more than the 3 cm asked, and the effort is more than the direct program's."""
    for target in ((0.0, 0.5), (1.0, 0.5)):
        assert 0.03 < launch_followed(jump(*target))["com"] < 0.09
        both = [hard_cases.effort(jump(*target, method=method).whole_body) for method in METHODS]
        assert 1.6 < both[0] / both[1] < 2.2, both


def test_the_same_words_everywhere():
    """The book and two notebooks say alike what three steps buy; the book's counts are the stored ones."""
    root = Path(__file__).resolve().parent.parent
    page = " ".join((root / "notebooks" / "book" / "validity.md").read_text(encoding="utf-8").split())
    said = re.search(r"Three steps give insight instead\. .*? 2\.4 % in inertia\.", page)[0]
    for stem in ("00_overview", "10_benchmark"):
        cells = json.loads((root / "notebooks" / f"{stem}.ipynb").read_text(encoding="utf-8"))["cells"]
        text = " ".join("".join(s for c in cells if c["cell_type"] == "markdown" for s in [*c["source"], "\n"]).split())
        assert said in text, stem
    every = next(row for row in hard_cases.compared(hard_cases.read()) if row["cases"] == "all")
    counted = (
        f"Three steps ended in a plan that passes the whole audit in {every['three-step, clean']} of "
        f"{every['number']} harder cases, the direct program in {every['direct, clean']}"
    )
    assert counted in page


def test_the_book_has_the_stored_counts():
    page = (Path(__file__).parent.parent / "notebooks" / "book" / "validity.md").read_text(encoding="utf-8")
    rows = [*worlds.counts(), *worlds.contact_counts()]
    assert len(rows) == 12 and all(f"\n{row}\n" in page for row in rows), "python -m paper.worlds --counts"
    for robot in capture.ROBOTS:
        assert capture.line(robot) in " ".join(page.split()), "python -m paper.capture"
