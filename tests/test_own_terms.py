"""Own terms, weights, switches, limits, settings and mesh: they reach every solve, and what does not fit is refused."""

import os
import re
import subprocess
import sys
from functools import cache, partial
from itertools import pairwise
from types import MappingProxyType, SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import planner, refused
from test_solver import flat_guess, move
from test_transcription import toy

import jumplab as jl
from jumplab.errors import InputError
from jumplab.ocp import Nlp, Problem, Term, changed
from jumplab.ocp import cache as kept
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.problem import Point
from jumplab.stages.changes import settled, sorted_out
from jumplab.stages.srmp import SrmpSettings
from jumplab.stages.srmp import build_problem as srmp_problem
from jumplab.stages.whole_body import Limits, Mesh, Weights, WholeBodyPlan
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import jump_contacts
from jumplab.stages.whole_body.coordinates import even
from jumplab.stages.whole_body.instant import Instant
from jumplab.stages.whole_body.problem import Schedule
from jumplab.studies.chain import Course, crouched, run_chain, run_chains

SMALL = Mesh(6, 4, 6)
STAGES = (
    "srmp/flat, srmp/toe, srmp/launch, srmp/flight, joint qp/launch, joint qp/flight, whole body/flat, whole body/toe, "
    "whole body/launch, whole body/flight"
)


def calm(weight: float = 0.1, name: str = "calm arms") -> Term:
    """A cost on the arms' rate against the trunk."""
    return Term(name, "ours", "rad/s", "node", lambda p: p.joint_rates.shoulder, weight=weight)


def cost(expression, name="x", at="node", **how) -> Term:
    return Term(name, "ours", "1", at, expression, **({"weight": 1.0} | how))


@cache
def plane_problem() -> Problem:
    """The whole-body program of jumps in the plane."""
    body, limits = Body(jl.Robot.load()), Limits()
    return Schedule(body, jump_contacts(limits, Mesh()), limits, Weights(), free=even(body)).problem()


def refuses(sentence: str, call, *arguments, **how) -> None:
    assert refused(call, *arguments, **how) == sentence


# problems -------------------------------------------------------------------------------------------------------
def test_a_weight_of_zero_is_no_term():
    usual = toy()
    assert changed(usual) is usual
    problem = changed(toy(), {"two": [cost(lambda p: p.q, weight=0.0)]})
    assert problem == changed(problem) and [t.name for _, t in problem.terms()] == [t.name for _, t in toy().terms()]
    assert not problem.own


def test_terms_weights_and_switches_of_a_problem():
    problem = changed(toy(), {"two": [cost(lambda p: p.q)]}, {"two/x": 3.0, "one/node cost": 7}, ["end row"])
    terms = {(owner, t.name): t for owner, t in problem.terms()}
    assert terms["two", "x"].weight == 3.0 and terms["one", "node cost"].weight == 7.0
    assert ("one", "end row") not in terms and set(problem.own) == {("two", "x")}
    assert len(problem.terms()) == len(toy().terms())
    assert [b.name for _, b in changed(toy(), off=["rest"]).bounds()] == []


TWO = "term 'x' of 'toy/two': "
TAKEN = "term '{}' of 'toy/two': another term has this name; choose another one"
SHAPE = TWO + "its expression has the shape {}; it must return a column of one row or more"
FAILS = TWO + "its expression cannot be evaluated ({})"
REFUSED = [
    (cost(lambda p: p.q, "jerk"), TAKEN.format("jerk")),
    (cost(lambda p: p.q, "jerk chain"), TAKEN.format("jerk chain")),
    (cost(lambda p: p.q, "a/b"), "term 'a/b' of 'toy/two': a name must not hold a '/'"),
    (cost(lambda p: p.q, at="problem"), f"{TWO}at = 'problem' joins phases; add the term to 'toy' instead"),
    (cost(lambda p: p.q, weight=-1.0), "weight 'x' = -1.0: it must be a number of 0 or more"),
    (cost(lambda p: p.q, weight=float("nan")), "weight 'x' = nan: it must be a number of 0 or more"),
    (cost(lambda p: 1 / 0), FAILS.format("ZeroDivisionError: division by zero")),
    (cost(lambda p: p.joints), FAILS.format("AttributeError: a point has no 'joints'")),
    (cost(lambda p: ca.horzcat(p.q, p.q)), SHAPE.format("(1, 2)")),
    (cost(lambda p: []), SHAPE.format("(0, 1)")),
    (cost(lambda p: ca.SX.sym("stray") * p.q),
     f"{TWO}it uses symbols from outside its point (stray); use only those of its point"),
    (cost(lambda p: p.q, weight=None, lower=[1.0, 2.0, 3.0], upper=9.0),
     f"{TWO}lower = [1.0, 2.0, 3.0] does not fit its expression, which has 1 row; give one number, or one per row"),
    (cost(lambda p: p.q, weight=None, lower=2.0, upper=1.0), f"{TWO}lower = 2.0 is above upper = 1.0"),
    (cost(lambda p: p.q, weight=None, upper="high"), f"{TWO}upper = 'high' is not a number"),
]  # fmt: skip


@pytest.mark.parametrize(("term", "sentence"), REFUSED)
def test_own_terms_that_are_refused(term, sentence):
    refuses(sentence, changed, toy(), {"two": [term]})


def test_names_that_are_refused():
    x = cost(lambda p: p.q)
    refuses(
        "term 'x': 'toy' has no phase 'three'; it has one, two, and 'toy' for terms that join them",
        changed, toy(), {"three": [x]},
    )  # fmt: skip
    refuses("term 'x' of 'toy/two': another term has this name; choose another one", changed, toy(), {"two": [x, x]})
    refuses(
        "term 'x' of 'toy': at = 'node', must be 'problem' for a term that joins phases", changed, toy(), {"toy": [x]}
    )
    refuses("an own term of 'toy/two' must be a Term, got 3", changed, toy(), {"two": [3]})
    refuses("toy: 'end row' is a constraint and has no weight; switch it off instead",
            changed, toy(), weights={"end row": 1.0})  # fmt: skip
    with pytest.raises(InputError, match=re.escape("weight or switch 'jrk': the problem 'toy' has no such term; it")):
        changed(toy(), off=["jrk"])
    refuses(
        "term 'base forces' ties the plan into one motion, as dynamics and links do; it cannot be switched off",
        changed, plane_problem(), off=["flat/base forces"],
    )  # fmt: skip


def test_symbols_of_another_phase_are_refused():
    seen = []
    first = cost(lambda p: seen.append(p.q) or p.q, "first")
    problem = changed(toy(), {"one": [first]})
    with pytest.raises(InputError, match=r"^term 'x' of 'toy/two': it uses symbols from outside its point \(x_"):
        changed(problem, {"two": [cost(lambda p: seen[0][0])]})


@pytest.mark.parametrize("expression", [lambda p: 1 / (p.q - p.q), lambda p: ca.sqrt(p.q), lambda p: ca.log(p.q - 1)])
def test_no_number_at_the_start_is_refused_before_the_solve(expression):
    nlp = Nlp(changed(move(), {"go": [cost(expression)]}))
    for solver in (nlp, nlp.with_options({}, hold=0.1)):
        refuses(
            "term 'x' of 'move/go': no finite value or derivative at the start of the solve; keep the arguments of its "
            "functions away from where they are singular, as in sqrt(x + 1e-6)",
            solver.solve, {"goal": 2.0}, flat_guess(),
        )  # fmt: skip


def test_a_bound_of_the_target_that_does_not_fit_is_refused():
    wide = cost(lambda p: p.q, weight=None, lower=lambda p: [0.0, 0.0, 0.0], upper=9.0)
    refuses(
        "term 'x' of 'move/go': a bound does not fit its expression, whose size is 1",
        Nlp(changed(move(), {"go": [wide]})).solve, {"goal": 2.0}, flat_guess(),
    )  # fmt: skip


def test_another_expression_is_another_file(tmp_path, monkeypatch):
    """Of own terms the expression counts, not the Python object; of others from elsewhere nothing is kept."""
    monkeypatch.setenv("JUMPLAB_CACHE", str(tmp_path))
    monkeypatch.setattr(kept, "HOME", (*kept.HOME, "test_transcription"))
    found = []
    for factor in (1.0, 2.0, 1.0):
        monkeypatch.setattr(kept, "KNOWN", {})  # as in another process
        problem = changed(toy(), {"two": [cost(lambda p, factor=factor: factor * p.q)]})
        parts = len(Assembled(problem, "k").parts)
        found.append(len(list(tmp_path.iterdir())) - parts)
    assert found == [0, 1, 1]  # of the parts, the one that holds the term is another


# stages and phases ----------------------------------------------------------------------------------------------
def test_changes_are_sorted_by_stage():
    found = sorted_out(
        {"SRMP/Launch": [calm()], "whole body/flight": calm(), "joint qp/launch": (calm(),)},
        {"srmp/flat/turn": 1.0, "jerk": 2.0, "flight/jerk": 3.0, "Whole Body/Toe/torque": 4.0, "joint qp/com": 5.0},
        ["srmp/friction"],
    )
    assert list(found["srmp"].terms) == ["launch"] and list(found["whole body"].terms) == ["flight"]
    assert found["srmp"].weights == {"flat/turn": 1.0} and found["joint qp"].weights == {"com": 5.0}
    assert found["whole body"].weights == {"jerk": 2.0, "flight/jerk": 3.0, "toe/torque": 4.0}
    assert found["srmp"].off == ("friction",) and list(found["joint qp"].terms) == ["launch"]


def test_the_launch_is_flat_foot_and_toe(bhr):
    start, end = cost(lambda p: p.L, "s", "start"), cost(lambda p: p.L, "e", "end")
    row = cost(lambda p: p.L, "r", weight=None, lower=-9.0, upper=9.0, skip=(1, 2))
    found = sorted_out({"srmp/launch": [start, end, row]}, {"srmp/launch/crouch depth": 1.0, "srmp/launch/turn": 2.0})
    problem = found["srmp"].applied(srmp_problem(bhr))
    terms = {(owner, t.name): t for owner, t in problem.terms()}
    assert {k for k in terms if k[1] in "ser"} == {("flat", "s"), ("toe", "e"), ("flat", "r"), ("toe", "r")}
    assert terms["flat", "r"].skip == (1, 0) and terms["toe", "r"].skip == (0, 2)
    assert terms["flat", "turn"].weight == terms["toe", "turn"].weight == 2.0
    assert terms["flat", "crouch depth"].weight == 1.0


def test_names_of_stages_that_are_refused(bhr):
    refuses(
        f"own terms of 'whole body/flght': there is no such stage and phase; there are {STAGES}",
        jl.Planner, bhr, terms={"whole body/flght": [calm()]},
    )  # fmt: skip
    refuses("own terms of 'srmp/flat' must be a list of terms, got 3", jl.Planner, bhr, terms={"srmp/flat": 3})
    refuses("an own term of 'srmp/flat' must be a Term, got 3", jl.Planner, bhr, terms={"srmp/flat": [3]})
    refuses("off must be a list of names, got 'jerk'", jl.Planner, bhr, off="jerk")
    refuses("the name of a weight or switch must be a text, got 3", jl.Planner, bhr, off=[3])


def test_settings_that_are_refused(bhr):
    with pytest.raises(InputError, match=r"^Limits has no 'torque'; it has torque_share, .* and \d+ more$"):
        jl.Planner(bhr, limits={"torque": 1.0})
    said = "Limits: friction = 'ice' must be of the same kind as its default, 0.42"
    refuses(said, jl.Planner, bhr, limits={"friction": "ice"})
    refuses("give a Limits or a mapping of its fields, got 3", jl.Planner, bhr, limits=3)
    said = "SrmpSettings: toe_s = 0.1 must be of the same kind as its default, (0.12, 0.12)"
    refuses(said, jl.Planner, bhr, settings={"toe_s": 0.1})
    refuses("mesh: toe = 1 intervals, must be a whole number of 2 or more", jl.Planner, bhr, mesh={"toe": 1})


def test_what_a_method_would_ignore_is_refused(bhr):
    task, start = jl.JumpTask(0.4, 0.3), "method 'direct' cannot use changes of "
    end = ": it takes limits, mesh and the terms of 'whole body'; choose 'three-step', or leave out these changes"
    for how, what in (
        (dict(terms={"srmp/flat": [calm()]}), "'srmp'"),
        (dict(off=["joint qp/friction"], weights={"srmp/turn": 1.0}), "'srmp' and 'joint qp'"),
        (dict(settings={"friction": 0.3}), "the settings of 'srmp'"),
    ):
        refuses(start + what + end, jl.Planner(bhr, **how).plan, task, "direct")
    refuses(start + "'srmp'" + end, planner().plan, task, "direct", weights={"srmp/turn": 1.0})
    with pytest.raises(InputError, match="'track inertia': the problem 'whole body' has no such term"):
        jl.Planner(bhr, weights={"track inertia": 1.0}, mesh=SMALL).plan(task, "direct")


def test_the_usual_method(bhr):
    """Direct; three steps where something is changed that only they have."""
    lopsided = bhr.with_mass("left_thigh", factor=1.2)
    assert not lopsided.planar
    assert planner().chosen() == jl.Planner(lopsided).chosen() == "direct"
    assert planner().chosen("three-step") == "three-step"
    for weights in ({"srmp/turn": 1.0}, {"track inertia": 1.0}):
        assert planner().chosen(weights=weights) == "three-step"
    for how in ({"off": ["joint qp/friction"]}, {"settings": {"friction": 0.3}}, {"off": ["launch/track inertia"]}):
        assert jl.Planner(bhr, **how).chosen() == "three-step", how
    assert jl.Planner(bhr, terms={"whole body/flight": [calm()]}).chosen() == "direct"


def test_nothing_solves_before_all_is_checked(bhr, monkeypatch):
    monkeypatch.setattr(Nlp, "solve", lambda *a, **k: pytest.fail("a stage was solved"))
    one = jl.Planner(bhr, mesh=SMALL, terms={"whole body/flight": [cost(lambda p: p.joints.elbow)]})
    refuses(
        "term 'x' of 'whole body/flight': its expression cannot be evaluated (AttributeError: there is no joint "
        f"'elbow'; there are {', '.join(bhr.joint_names)}, hip, knee, ankle, shoulder)",
        one.plan, jl.JumpTask(0.4, 0.3),
    )  # fmt: skip
    with pytest.raises(InputError, match="weight or switch 'jrk': the problem 'whole body' has no such term"):
        planner().plan(jl.JumpTask(0.4, 0.3), weights={"jrk": 1.0})


def test_what_is_given_wins_over_what_a_flip_needs():
    assert settled(Limits, None, True) == Limits().of_flip() and settled(Limits, None) == Limits()
    given = settled(Limits, {"torque_share": 0.7, "touchdown_trunk_rate": 1.0}, True)
    assert (given.torque_share, given.touchdown_trunk_rate, given.least_push) == (0.7, 1.0, 0.04)
    assert settled(Limits, Limits(torque_share=0.7), True).capture_moment == Limits().of_flip().capture_moment
    assert settled(SrmpSettings, MappingProxyType({"momentum": (-20.0, 20.0)}), True).momentum == (-20.0, 20.0)
    assert settled(Limits, {"touchdown_ankle_stroke": None}, True).touchdown_ankle_stroke is None
    assert settled(Limits, {"capture_moment": 5.0}, True).capture_moment == 5.0


def test_flips_and_direct_have_it_all(bhr):
    one = jl.Planner(
        bhr, mesh=SMALL, limits={"torque_share": 0.7}, terms={"whole body/flight": [calm()]},
        weights={"jerk": 1e-6}, off=["body clearance"],
    )  # fmt: skip
    flip = jl.JumpTask(0.0, 0.4, rotation_rad=2 * np.pi)
    steps = one.stage("whole body"), one.stage("whole body", flip=True)
    aside = jl.JumpTask(0.0, 0.3, side_m=0.2)
    assert all(stage.mesh == SMALL and stage.limits.torque_share == 0.7 for stage in steps)
    programs = [one.program(task) for task in (jl.JumpTask(0.5, 0.3), flip, aside)]
    programs += [stage.program(flip) for stage in steps]
    for program in programs:
        assert sum(p.intervals for p in program.contacts.phases) == sum(SMALL.intervals().values())
        for nlp in (program.nlp, program.finer.nlp):
            terms = {(owner, t.name): t for owner, t in nlp.problem.terms()}
            assert terms["flight", "calm arms"].weight == 0.1 and terms["toe", "jerk"].weight == 1e-6
            assert not any(term == "body clearance" for _, term in terms)
            assert ("flight", "calm arms") in [(owner, t.name) for owner, t in nlp.assembled.cost_terms]
    friction = jl.Planner(bhr, settings={"friction": 0.3}, weights={"srmp/turn": 1.0}).stage("srmp", flip=True)
    assert friction.settings.friction == 0.3 and friction.settings.momentum == (-32.0, 32.0)


# what a term sees -----------------------------------------------------------------------------------------------
def test_what_is_seen_is_named(bhr):
    with pytest.raises(InputError, match="a point of this phase has no 'joint'; it has L, attitude, com, com_velocity"):
        changed(plane_problem(), {"flight": [cost(lambda p: p.joint.knee)]})
    with pytest.raises(
        InputError, match="a point of this phase has no 'posture'; it has L, air_time, com, com_velocity"
    ):
        changed(srmp_problem(bhr), {"flight": [cost(lambda p: p.posture)]})
    with pytest.raises(InputError, match="the robot has no point 'nose'; it has left_ankle_pitch, left_ankle_roll"):
        changed(plane_problem(), {"flight": [cost(lambda p: p.point("nose"))]})


def test_terms_are_listed():
    one = jl.Planner(jl.Robot.load(), mesh=SMALL, terms={"whole body/flight": [calm()]}, off=["srmp/friction"])
    rows = one.terms()
    assert {r["stage"] for r in rows} >= {"SRMP", "whole body"}
    (own,) = (r for r in rows if r["name"] == "calm arms")
    assert own == dict(stage="whole body", phase="flight", name="calm arms", kind="cost", at="node", unit="rad/s",
                       equation="ours", value="weight 0.1")  # fmt: skip
    assert not [r for r in rows if r["stage"] == "SRMP" and r["name"] == "friction"]
    assert "calm arms" in repr(jl.plots.table(rows))


# solved ---------------------------------------------------------------------------------------------------------
GROWING = (0.0, 0.01, 0.1, 1.0, 10.0)
SLACK = 1e-3  # share of the value by which a solve's tolerance may miss


def swing(body: WholeBodyPlan) -> float:
    """Integral of the square of the arms' rate against the trunk over the flight, as the cost has it [rad^2/s]."""
    flight, names = body.solution.phases["flight"], body.schedule.modes[2].coordinates
    rate = flight.v[:, names.index("left_shoulder_pitch")] ** 2
    return float((rate.sum() - (rate[0] + rate[-1]) / 2) * flight.duration / (len(rate) - 1))


def turning(phases) -> float:
    """Integral of the square of the trunk's pitch of the rod over the launch [rad^2 s]."""
    total = 0.0
    for phase in (phases["flat"], phases["toe"]):
        square = (phase.q[:, 0] + phase.q[:, 2]) ** 2
        total += (square.sum() - (square[0] + square[-1]) / 2) * phase.duration / (len(square) - 1)
    return float(total)


@cache
def armed(weight: float, **how) -> jl.Planner:
    return jl.Planner(jl.Robot.load(), terms={"whole body/flight": [calm(weight)]}, **how)


def falls(values: list[float]) -> bool:
    return all(b <= a * (1 + SLACK) for a, b in pairwise(values)) and values[-1] < values[0]


def same(one: jl.JumpPlan, other: jl.JumpPlan) -> None:
    for name in ("t", "q", "v", "a", "tau", "f"):
        np.testing.assert_allclose(getattr(one.tape, name), getattr(other.tape, name), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("method", ["three-step", "direct"])
def test_a_weight_of_zero_changes_nothing(method):
    task, usual = jl.JumpTask(0.4, 0.3), planner().plan(jl.JumpTask(0.4, 0.3), method)
    same(armed(0.0).plan(task, method), usual)
    same(armed(0.1).plan(task, method, weights={"flight/calm arms": 0}), usual)


@pytest.mark.slow
def test_a_weight_of_zero_in_one_plan_leaves_that_term_alone_out():
    task, rod = jl.JumpTask(0.4, 0.3), jl.Term("upright", "ours", "rad", "node", lambda p: p.posture, weight=1.0)
    both = jl.Planner(jl.Robot.load(), terms={"srmp/launch": [rod], "whole body/flight": [calm()]})
    asked = {"srmp/launch/upright": 0, "calm arms": 0.2}
    for _ in range(2):
        plan = both.plan(task, weights=asked)
        same(plan, armed(0.2).plan(task, "three-step"))
        assert plan.weights["SRMP"]["toe/upright"] == 0 and plan.weights["whole body"]["flight/calm arms"] == 0.2
    assert both.plan(task).weights["SRMP"]["toe/upright"] == 1.0


def test_a_solved_plan_lists_its_terms():
    plan = armed(0.1).plan(jl.JumpTask(0.4, 0.3), "three-step")
    rows = {(r["stage"], r["phase"], r["name"]): r for r in plan.terms()}
    own, place = (rows["whole body", "flight", name] for name in ("calm arms", "touchdown of the feet"))
    assert 0 < own["share"] < 1 and own["node"] is None and own["value"] == "weight 0.1"
    last = plan.whole_body.schedule.contacts.phases[-1].intervals
    assert place["share"] is None and place["node"] == last and abs(place["slack"]) < 1e-4
    cost = own["share"] * plan.whole_body.solution.statistics.objective
    assert cost == pytest.approx(0.1 * 2 * swing(plan.whole_body), rel=1e-9)  # of both arms
    for stage in ("SRMP", "whole body"):
        assert sum(r["share"] or 0 for r in plan.terms() if r["stage"] == stage) == pytest.approx(1)
    assert plan.weights["whole body"]["flight/calm arms"] == 0.1
    with pytest.raises(InputError):  # a name of this plan's own is nobody else's
        planner().plan(jl.JumpTask(0.4, 0.3), weights={"calm arms": 1.0})


def test_a_weight_of_one_plan_is_that_of_a_planner():
    task = jl.JumpTask(0.4, 0.3)
    one = armed(0.1).plan(task, weights={"calm arms": 1.0, "srmp/launch/turn": 9.0})
    other = jl.plan(task, terms={"whole body/flight": [calm(1.0)]}, weights={"srmp/turn": 9.0})
    same(one, other)
    assert one.weights["SRMP"]["toe/turn"] == 9.0


SCRIPT = """
import sys
import numpy as np
import jumplab as jl
term = jl.Term("calm arms", "ours", "rad/s", "node", lambda p: p.joint_rates.shoulder, weight=0.3)
rod = jl.Term("upright", "ours", "rad", "node", lambda p: p.posture, weight=1.0)
if sys.argv[2] == "other":  # the same names, other expressions
    term = jl.Term("calm arms", "ours", "rad/s", "node", lambda p: 2 * p.joint_rates.shoulder, weight=0.3)
robot, task = jl.Robot.load(), jl.JumpTask(0.4, 0.3)
planner = jl.Planner(robot, terms={"whole body/flight": [term], "srmp/launch": [rod]}, keep=True)
np.savez(sys.argv[1], q=planner.plan(task).tape.q)
"""


@pytest.mark.slow
def test_cached_and_uncached_processes_plan_the_same(tmp_path):
    found, files = {}, []
    runs = ("fresh", "this"), ("again", "this"), ("other", "other"), ("none", "this")
    for name, which in runs:
        env = os.environ | {"JUMPLAB_CACHE": "" if name == "none" else str(tmp_path / "cache")}
        subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path / f"{name}.npz"), which], env=env, check=True)
        found[name] = np.load(tmp_path / f"{name}.npz")["q"]
        files.append(len(list((tmp_path / "cache").glob("*.json"))))
    np.testing.assert_allclose(found["fresh"], found["again"], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found["fresh"], found["none"], rtol=0, atol=1e-7)
    assert found["other"].shape != found["fresh"].shape or np.abs(found["other"] - found["fresh"]).max() > 1e-3
    # the part that holds the other expression is new
    assert files[0] > 10 and np.diff(files).tolist() == [0, 1, 0]


@pytest.mark.slow
def test_a_growing_weight_calms_the_arms_in_every_path():
    task, near = jl.JumpTask(0.6, 0.4), jl.JumpTask(0.62, 0.4)
    plans = {w: armed(w).plan(task) for w in GROWING}
    assert falls([swing(plans[w].whole_body) for w in GROWING])
    again = {w: armed(w).replan(plans[w], near) for w in GROWING}
    assert falls([swing(again[w].whole_body) for w in GROWING])
    direct = [armed(w).plan(task, "direct") for w in GROWING]
    assert falls([swing(plan.whole_body) for plan in direct])


@pytest.mark.slow
def test_a_growing_weight_straightens_stage_one():
    rods = [jl.Term("upright", "ours", "rad", "node", lambda p: p.posture, weight=w) for w in GROWING]
    how = [jl.Planner(jl.Robot.load(), terms={"srmp/launch": [rod]}).stage("srmp") for rod in rods]
    assert falls([turning(stage.plan(jl.JumpTask(0.6, 0.4)).solution.phases) for stage in how])


@pytest.mark.slow
def test_weights_of_a_flip():
    """Those of one plan are those of a planner, and a weight of zero changes nothing."""
    task = jl.JumpTask(0.0, 0.4, rotation_rad=-2 * np.pi)
    usual = planner().plan(task, "direct")
    light = armed(0.1)
    same(light.plan(task, "direct", weights={"calm arms": 0}), usual)
    same(light.plan(task, "direct", weights={"calm arms": 0.2}), armed(0.2).plan(task, "direct"))


@pytest.mark.slow
def test_chains_plan_with_own_terms():
    robot = jl.Robot.load()
    one = jl.Planner(crouched(robot), terms={"whole body/flight": [calm(1.0)]})
    run = run_chain(Course.of([0.4], 0.3), robot, planner=one, solve_s=0.3)
    used = run.jumps[0].ahead.plan
    assert ("flight", "calm arms") in used.whole_body.solution.problem.own
    assert run_chains(Course.of([0.4], 0.3), robot, 1, planner=one, solve_s=0.3, jobs=1)["stood"] == 1


@pytest.mark.slow
def test_a_jump_under_another_gravity_is_planned_audited_and_lands():
    for method in ("three-step", "direct"):
        plan = jl.plan(jl.JumpTask(0.6, 0.5, gravity=3.7), method=method)
        run = jl.simulate(plan)
        assert plan.robot.gravity == 3.7 and jl.audit(plan).passed and run.landed
        assert abs(run.metrics.foot_distance_m - 0.6) < 0.02 and abs(run.metrics.com_rise_m - 0.5) < 0.01


@pytest.mark.parametrize("aside", [{}, {"side_m": 0.2, "yaw_rad": 0.5}], ids=["ahead", "aside"])
def test_what_a_term_sees_is_what_pinocchio_says(bhr, aside):
    """At nodes of a plan, in the program of even motions and in that of all: with its solution as numbers."""
    plan = planner().plan(jl.JumpTask(0.3, 0.3, **aside))
    body = plan.whole_body
    tree, data = bhr.model, bhr.model.createData()
    names = ("com", "com_velocity", "L", "inertia", "posture", "wrench")
    for k, (phase, node) in enumerate((("flat", 5), ("toe", 4), ("flight", 6))):
        x, b = body.solution.phases[phase], body.schedule.modes[k]
        spaces = SimpleNamespace(**{n: ca.SX(v) for n, v in x.constants.items()}), SimpleNamespace(gravity=9.8)
        state = (ca.SX(y[node]) for y in (x.q, x.v, x.a))
        point = Point(*state, None, ca.SX(x.z[node]), x.duration, x.t[node] / x.duration, *spaces, None,
                      view=partial(Instant, b))  # fmt: skip
        seen = {name: ca.evalf(ca.vec(getattr(point, name))).full().ravel() for name in names}
        motion = point.tree.q, point.tree.v, point.tree.a
        chart = [ca.evalf(y).full().ravel()[None] for y in motion]
        q, v, a = (y[0] for y in b.model.to_pinocchio(*chart))
        pin.ccrba(tree, data, q, v)
        pin.centerOfMass(tree, data, q, v)
        np.testing.assert_allclose(seen["com"], data.com[0], atol=1e-9)
        np.testing.assert_allclose(seen["com_velocity"], data.vcom[0], atol=1e-9)
        np.testing.assert_allclose(seen["L"], data.hg.angular, atol=1e-8)
        np.testing.assert_allclose(seen["inertia"].reshape(3, 3), data.Ig.inertia, atol=1e-9)
        assert seen["posture"] == pytest.approx(chart[0][0, 5], abs=1e-12)
        need = pin.rnea(tree, data, q, v, a)[:6]  # of the base, in its axes, at its origin
        turn = data.oMi[1].rotation
        force = turn @ need[:3]
        moment = turn @ need[3:] + np.cross(data.oMi[1].translation, force)
        np.testing.assert_allclose(seen["wrench"], [*force, *moment], atol=0.5)  # N, N m; rows are met to that
        pin.forwardKinematics(tree, data, q, v)
        pin.updateFramePlacements(tree, data)
        for i, side in enumerate(("left", "right")):
            frame = bhr.model.getFrameId(bhr.foot.frames[i])
            heel = (bhr.foot.corners[0] + bhr.foot.corners[1]) / 2
            place = ca.evalf(point.point(f"{side}_heel")).full().ravel()
            np.testing.assert_allclose(place, data.oMf[frame].act(heel), atol=1e-9)
            speed = pin.getFrameVelocity(tree, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            arm = data.oMf[frame].rotation @ heel
            fast = ca.evalf(point.point_velocity(f"{side}_heel")).full().ravel()
            np.testing.assert_allclose(fast, speed.linear + np.cross(speed.angular, arm), atol=1e-9)
        knees = [q[7 + bhr.joint_names.index(f"{side}_knee")] for side in ("left", "right")]
        signs = bhr.sagittal.signs[1]
        np.testing.assert_allclose(ca.evalf(point.joints.knee).full().ravel(), np.multiply(signs, knees), atol=1e-12)
        assert float(ca.evalf(point.joints.right_knee)) == pytest.approx(knees[1])
        if phase == "flight":
            assert not np.any(seen["wrench"])
            tape = plan.tape
            column, rows = bhr.joint_names.index("left_shoulder_pitch"), tape.phase == "flight"
            on_tape = np.interp(tape.takeoff_time + x.t[node], tape.t[rows], tape.tau[rows, column])
            both = ca.evalf(point.torques.shoulder).full().ravel() * bhr.sagittal.signs[3]
            np.testing.assert_allclose(both[0], on_tape, atol=0.2)  # N m; between the nodes joints are polynomials
