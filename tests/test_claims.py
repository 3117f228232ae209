"""The claims' verdicts, the measurements behind them against a second way, and the gathered table of readings."""

import json

import numpy as np
import pytest
from paper import claims
from paper.claims import Start, against_crouch, compare_starts, judge, readings, readings_markdown

from jumplab.cli import notebooks
from jumplab.errors import InputError
from jumplab.task import JumpTask

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
    rows = compare_starts([JumpTask(1.0, 0.5)], bhr)  # where all lead to one solution; slow jumps have several
    assert [r.start for r in rows] == list(claims.STARTS)
    assert all(r.iterations > 0 and 0 < r.alone_s <= r.total_s for r in rows), rows
    crouch, guess, loose = rows
    assert loose.total_s > loose.alone_s and guess.total_s > guess.alone_s
    assert guess.cost == pytest.approx(crouch.cost, rel=0.05) and loose.cost == pytest.approx(crouch.cost, rel=0.05)


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
