"""Records: a number of the target as large as can be, what ends it, and what more of a limit buys."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_robots import needs_published

import jumplab as jl
from jumplab.cli.main import main
from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.ocp import Bound, Nlp, Phase, PhaseGuess, Problem, Term
from jumplab.ocp.nlp import patience
from jumplab.show import price_bars
from jumplab.stages.whole_body.program import Program
from jumplab.studies import record as study

pytestmark = pytest.mark.slow  # the record takes ten seconds, its prices as long


@pytest.fixture(scope="module")
def highest():
    """The highest jump of the default robot."""
    return jl.record("bhr", "height_m", engines=())


@pytest.fixture(scope="module")
def prices(highest):
    return highest.prices(most=4)


@pytest.fixture(scope="module")
def better(highest):
    return highest.improve({"gear": ["knee"], "thigh_m": (0.34, 0.36)}, budget=1)


def test_a_constant_with_the_name_of_a_parameter_takes_its_place():
    """A run of one second from rest to rest, as far as a rate of 1 m/s and 8 m/s^2 allow."""
    far = Term("far", "ours", "m", "end", lambda p: 10.0 - p.p.goal, 1.0)
    there = Term("goal", "ours", "m", "end", lambda p: p.q - p.p.goal)
    ends = (("q", "start"), ("v", "start"), ("v", "end"))
    stops = [Bound(f"{on} {at}", "ours", "m", on, 0, 0, at) for on, at in ends]
    limits = (Bound("rate", "ours", "m/s", "v", -1, 1), Bound("push", "ours", "m/s^2", "a", -8, 8))
    known = {"goal": (0.0, 5.0, 1.0)}
    phase = Phase("go", ("x",), 40, (1.0, 1.0), (far, there), (*stops, *limits), constants=known)
    nlp = Nlp(Problem("run", (phase,), parameters={"goal": 1}))
    found = nlp.solve({"goal": 0.1}, {"go": PhaseGuess(1.0, np.zeros((41, 1)))}).phases["go"]
    # from 0 to 1 m/s by straight lines of the acceleration takes at least 1/8 s and one interval
    assert 0.8 < found.constants["goal"] < 0.875
    assert found.q[-1, 0] == pytest.approx(found.constants["goal"], abs=1e-6)


def test_a_record_is_a_clean_plan_and_no_easier_start_beats_it(highest):
    assert highest.audit.passed and highest.plan.task.height_m == highest.value
    assert highest.plan.planned_rise_m == pytest.approx(highest.value, abs=5e-3)
    assert 0.94 < highest.value < 1.0 and len(highest.found) == 6 and highest.alike >= 3
    assert "at least" in highest.line() and f"{highest.value:.3f} m" in highest.line()
    with pytest.raises(dataclasses.FrozenInstanceError):
        highest.value = 2.0


def test_what_ends_a_record_is_named_with_joint_phase_and_time(highest):
    first = highest.limits[0]
    assert (first.limit, first.joint) == ("upper stop", "left_knee")
    assert {"torque-speed", "torque"} <= {x.limit for x in highest.limits if x.phase == "toe"}
    worths = [x.worth for x in highest.limits]
    assert worths == sorted(worths, reverse=True) and worths[-1] > 0
    end = float(highest.plan.tape.t[-1])
    assert all(0 <= x.from_s <= x.to_s <= end + 1e-6 for x in highest.limits)


def test_prices_are_those_of_records_with_the_limit_moved(prices):
    rows = {row.limit: row for row in prices.rows}
    assert {"knee speed", "knee torque", "knee upper stop", "friction"} <= set(rows)
    assert rows["knee torque"].price > 0 > rows["mass, everywhere"].price
    assert rows["thighs and shanks"].price > 0 and rows["knee speed"].unit == "rad/s"
    kept = [row for row in prices.rows if row.stays]
    assert len(kept) >= 4
    for row in kept:
        assert row.gap <= 0.05, row


def test_records_and_prices_have_cards_and_bars(highest, prices):
    assert "upper stop" in highest._repr_html_() and "Record" in highest._repr_html_()
    assert "knee speed" in prices._repr_html_()
    bars = price_bars(prices)
    names = [label.get_text() for label in bars.axes[0].get_yticklabels()]
    assert len(names) == min(14, len(prices.rows)) and any("1 % (" in name for name in names)


def test_a_robot_without_an_easy_jump_has_no_record(bhr):
    none = r"no record of height_m, since none of 5 easy jumps"
    with patience(1.0), pytest.raises(InfeasibleError, match=none):
        jl.record(bhr.with_limits(effort=0.1), "height_m", engines=())


@needs_published
@pytest.mark.parametrize(("robot", "what", "least"), [("alexander", "height_m", 0.23), ("talos", "platform_m", 0.055)])
def test_a_record_passes_its_audit_near_the_largest_number_at_the_nodes(robot, what, least):
    """Alexander would lay its trunk on the ground; a finer mesh alone leads Talos to less than a third."""
    found = jl.record(robot, what, engines=())
    assert found.audit.passed and found.alike >= 3 and found.value > max(least, 0.97 * found.best)


def test_where_an_easy_jump_is_not_easy_half_of_it_is_the_start(bhr, monkeypatch):
    monkeypatch.setitem(study.EASY, "height_m", ((1.8, 1.8),))
    with patience(2.0):
        found = jl.record(bhr, "height_m", jl.JumpTask(0.3, 0.2), engines=())
    first, half, *_ = found.found.values()
    assert np.isnan(first) and half > 0.9 and found.audit.passed


@pytest.fixture
def shares(bhr, monkeypatch):
    """A record of bhr that no finer mesh has a plan for, and the shares of it that are planned: (target, near)."""
    stage, asked = type(jl.Planner(bhr).stage("direct")), []
    refined, plan = stage.refined, stage.plan

    def without_the_record(self, program, given, start):
        if start is study.RECORD:
            raise SolverError("no plan on a finer mesh")
        return refined(self, program, given, start)

    def noted(self, task, *given, **options):
        if "near" in options:
            asked.append((task, options["near"]))
        return plan(self, task, *given, **options)

    monkeypatch.setattr(stage, "refined", without_the_record)
    monkeypatch.setattr(stage, "plan", noted)
    return lambda what: (jl.record(bhr, what, engines=()), asked)


def test_where_no_finer_mesh_has_a_plan_shares_are_planned_afresh_and_less_high(shares):
    """Of what is sought, and of the rise above the usual 0.2 m, each share is the same."""
    found, asked = shares("platform_m")
    platforms, rises = np.transpose([(task.platform_m, task.height_m - 0.2) for task, _ in asked])
    assert found.audit.passed and found.value == max(x for x in platforms if x <= found.value) < found.best
    assert len(asked) == study.HALVINGS and platforms[0] == pytest.approx(found.best / 2) and asked[0][1] is None
    assert rises / platforms == pytest.approx(rises[0] / platforms[0]) and rises[0] > 0


def test_a_share_of_a_rise_is_that_share_of_it(shares):
    found, asked = shares("height_m")
    parts = 32 * np.array([task.height_m / found.best for task, _ in asked])
    assert found.audit.passed and found.value > 0.9 * found.best
    assert parts[0] == pytest.approx(16) and parts == pytest.approx(np.round(parts), abs=1e-6)


def test_where_nothing_is_found_at_once_plans_lead_there(bhr, monkeypatch):
    solve, given = Program.solve_apart, jl.JumpTask(0.3, 0.2)

    def not_at_once(self, asked, start):
        if start is study.SEEKING:
            raise SolverError("no way there at once")
        return solve(self, asked, start)

    usual = jl.record(bhr, "height_m", given, engines=())
    monkeypatch.setattr(Program, "solve_apart", not_at_once)
    found = jl.record(bhr, "height_m", given, engines=())
    assert found.audit.passed and found.value == pytest.approx(usual.value, rel=0.02)


@needs_published
def test_a_record_is_played_at_a_share_of_its_rise_too(monkeypatch):
    """Of what is sought and of the rise that was sought besides."""
    plan, played = jl.Planner.plan, []

    def noted(self, task, *given, **options):
        played.append(task)
        return plan(self, task, *given, **options)

    monkeypatch.setattr(jl.Planner, "plan", noted)
    found = jl.record("g1_legs", "platform_m", share=0.9, engines=["mujoco"])
    most, (less, *_) = found.plan.task, played
    assert (less.platform_m, less.height_m) == pytest.approx((0.9 * most.platform_m, 0.9 * most.height_m))
    assert less.distance_m == most.distance_m and found.runs["mujoco"].landed


def test_a_record_that_only_a_number_of_the_problem_ends_is_refused_in_a_sentence(bhr):
    with pytest.raises(InfeasibleError, match=r"distance_m = 3 m, the largest that a target may have") as e:
        jl.record(bhr, "distance_m", engines=())
    assert (e.value.number, e.value.bound) == ("distance_m", 3.0)
    on_the_moon = jl.JumpTask(0.0, 0.2, gravity=1.62)
    with pytest.raises(InfeasibleError, match=r"the flight of 1.5 s, the longest .* \(0.05, 3\)"):
        jl.record(bhr, "height_m", on_the_moon, engines=())


@pytest.mark.parametrize(
    ("what", "options", "sentence"),
    [
        ("gravity", {}, "a record is one of height_m, distance_m"),
        ("height_m", {"share": 0.0}, "share = 0 must be above 0"),
        ("height_m", {"given": 3}, "given"),
        ("height_m", {"engines": ("ode",)}, "ode"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_solved(what, options, sentence, monkeypatch):
    monkeypatch.setattr(study, "_Search", None)
    with pytest.raises(InputError, match=sentence):
        jl.record("bhr", what, **options)


def test_smaller_shares_are_played_one_after_the_other(monkeypatch):
    """If no engine lands: 95, 90, 85, 80 and 75 % are tried, and the last one is told."""
    said = []
    monkeypatch.setattr(study, "tell", said.append)
    monkeypatch.setattr(study, "simulate_jump", lambda *given, **how: SimpleNamespace(landed=False))
    found = jl.record("bhr", "height_m", jl.JumpTask(0.2, 0.2))
    tried = [words.split()[1] for words in said if words.startswith("playing")]
    assert tried == ["95%", "90%", "85%", "80%", "75%"] and found.share == pytest.approx(0.75)


def test_the_command_prints_the_record_and_its_prices(highest, prices, monkeypatch, capsys, tmp_path):
    asked = {}

    def known(robot, what, given, share):
        asked.update(robot=robot, what=what, given=given, share=share)
        return highest

    monkeypatch.setattr(study, "priced", lambda *_: prices)
    monkeypatch.setattr(study, "record", known)
    out = tmp_path / "high"
    assert main(["record", "bhr", "height_m", "--distance-m", "0.1", "--prices", "--out", str(out)]) == 0
    assert asked["given"] == jl.JumpTask(0.1, 0.2) and asked["share"] == 0.95 and asked["what"] == "height_m"
    text = capsys.readouterr().out
    assert "height at least" in text and "knee speed" in text and (out / "plan.npz").is_file()
    assert main(["record", "bhr", "height_m", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["record"]
    assert found["value"] == highest.value and found["limits"][0]["limit"] == "upper stop"
    assert found["bound"] == highest.bound


def test_the_command_improves_a_robot_and_saves_the_one_that_came_out(highest, better, monkeypatch, capsys, tmp_path):
    asked = []
    monkeypatch.setattr(study, "record", lambda *_, **options: highest)
    monkeypatch.setattr(study.Record, "improve", lambda _, free: asked.append(free) or better)
    out = tmp_path / "better"
    assert main(["record", "bhr", "height_m", "--improve", "knee,hip", "--out", str(out)]) == 0
    assert asked == [{"gear": ["knee", "hip"]}] and "gear of knee 1 -> 0.92" in capsys.readouterr().out
    assert jl.load(out).plan.robot.hash == better.robot.hash


def test_a_record_stands_below_its_bound(highest):
    assert highest.value < highest.bound and "no bound below 3 times" in highest.line()
    known = dataclasses.replace(highest, bound=1.2)
    assert f"at least {highest.value:.3f} m and at most 1.20 m" in known.line()


def test_a_few_priced_steps_lead_to_a_robot_that_jumps_higher(highest, better, bhr):
    assert better.after.value > 1.04 * highest.value and better.after.audit.passed
    rows = {x.number: x for x in better.changes}
    assert rows["gear of knee"].after == pytest.approx(0.92) and rows["thigh"].after == pytest.approx(0.36)
    assert rows["thigh"].ends and not rows["gear of knee"].ends and all(x.buys > 0 for x in better.changes)
    # to first order the prices add up to what it buys
    bought = sum(x.buys for x in better.changes)
    assert bought == pytest.approx(better.after.value - highest.value, rel=0.2)
    knee = better.robot.actuators["left_knee"]
    ratio = rows["gear of knee"].after
    assert knee["effort"] == pytest.approx(ratio * bhr.actuators["left_knee"]["effort"])
    assert knee["speed"] == pytest.approx(bhr.actuators["left_knee"]["speed"] / ratio)
    assert "gear of knee 1 -> 0." in better.line() and "thigh 0.35 -> 0.36 m (at its end)" in better.line()
    assert "gear of knee" in better._repr_html_()


@pytest.mark.parametrize(
    ("free", "sentence"),
    [
        ({}, "must be a mapping of what may change, from gear, thigh_m, shank_m, mass_kg"),
        ({"gear": ["elbow"]}, "'elbow', which is neither a role"),
        ({"gear": {"knee": (2, 1)}}, "the range of gear of knee must be positive and in order"),
        ({"gear": 3}, "give joints or roles"),
        ({"thigh_m": (1, 2)}, "thigh is 0.35 now, outside the given range 1 ... 2; widen it"),
        ({"mass_kg": {"hat": (1, 2)}}, "cannot change the mass of 'hat': there is no such link"),
        ("gear", "free must be a mapping"),
    ],
)
def test_what_is_no_number_of_the_robot_is_refused(highest, free, sentence):
    with pytest.raises(InputError, match=sentence):
        highest.improve(free)
