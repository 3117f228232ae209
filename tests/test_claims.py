"""The claims' verdicts, the measurements behind them against a second way, and the gathered table of readings."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, planner
from paper import claims, hard_cases
from paper.claims import Start, against_crouch, compare_starts, judge, readings, readings_markdown
from paper.tracking import launch_followed

from jumplab.cli import notebooks
from jumplab.errors import InputError
from jumplab.models.full import FullBody
from jumplab.sim import STEP_S
from jumplab.stages.planner import METHODS
from jumplab.task import GRAVITY, JumpTask

# ------------------------------------------------------------------------------------------ verdicts


@pytest.mark.parametrize(
    ("ok", "change", "verdict"),
    [
        (True, "", "holds"),
        (np.bool_(True), "half of it", "holds with a change"),
        (False, "", "does not hold"),
        (False, "half of it", "does not hold"),
        (None, "", "cannot be checked here"),
    ],
)
def test_verdict_follows_the_measurement(ok, change, verdict):
    row = judge("it jumps", ok, "1.0 m", "00_overview", change)
    assert judge("it jumps", ok, "1.0 m", "00_overview", change, adopted=True)["verdict"] == (
        "adopted: ours by construction" if ok else verdict
    )
    assert row == {
        "claim": "it jumps",
        "verdict": verdict,
        "measured": "1.0 m",
        "change": change,
        "where": "00_overview",
    }


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("", True, "1 m", "x"), "claim of a claim must be a text, got ''"),
        (("it jumps", True, " ", "x"), "measured of a claim must be a text, got ' '"),
        (("it jumps", True, 1.0, "x"), "measured of a claim must be a text, got 1.0"),
        (("it jumps", 1, "1 m", "x"), "verdict of a claim must be True, False or None, got 1"),
    ],
)
def test_a_verdict_without_numbers_is_refused(arguments, sentence):
    with pytest.raises(InputError) as e:
        judge(*arguments)
    assert str(e.value).startswith(sentence)


# ------------------------------------------------------------------------------------------ measurements


def test_standing_height(bhr):
    assert claims.standing_height_m(bhr) == pytest.approx(1.5, abs=1e-9)
    with pytest.raises(InputError, match="the robot must be a Robot, got 'bhr'"):
        claims.standing_height_m("bhr")


def test_five_links_are_nine(bhr):
    differ = claims.five_against_nine(bhr, samples=5, seed=3)
    assert set(differ) == {"mass [kg]", "CoM [m]", "L [kg m^2/s]", "rho [kg m^2]"}
    assert max(differ.values()) < 1e-9, differ


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
    with pytest.raises(InputError) as e:
        readings([write(tmp_path / "00_a.ipynb", source)])
    assert str(e.value).startswith(sentence)


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


def test_the_same_words_everywhere():
    """The book and three notebooks say alike what three steps buy; the book's counts are the stored ones."""
    root = Path(__file__).resolve().parent.parent
    page = " ".join((root / "notebooks" / "book" / "validity.md").read_text(encoding="utf-8").split())
    said = re.search(r"The paper's reason for three steps is time\. .*? 2 % of the inertia\.", page)[0]
    for stem in ("00_overview", "04_whole_body", "10_benchmark"):
        cells = json.loads((root / "notebooks" / f"{stem}.ipynb").read_text(encoding="utf-8"))["cells"]
        text = " ".join("".join(s for c in cells if c["cell_type"] == "markdown" for s in [*c["source"], "\n"]).split())
        assert said in text, stem
    every = next(row for row in hard_cases.compared(hard_cases.read()) if row["cases"] == "all")
    counted = (
        f"Three steps ended in a clean plan in {every['three-step, clean']} of {every['number']} "
        f"harder cases, the direct program in {every['direct, clean']}"
    )
    assert counted in page and "made with the five-link program" in page
