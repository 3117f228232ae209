"""Solving: a problem with a known answer, what comes out of it, and every way of failing."""

import re

import casadi as ca
import numpy as np
import pytest
from fixtures_core import refused

from jumplab.errors import InputError, JumplabError, SolverError
from jumplab.ocp import changed
from jumplab.ocp.nlp import GOOD_STATUSES, Nlp, PhaseGuess
from jumplab.ocp.problem import Bound, Phase, Problem, Term

N = 30


def move(*extra, bounds=(), duration=(1.0, 1.0), **other) -> Problem:
    """From rest at 0 to rest at the goal with the least jerk."""
    terms = (
        Term("jerk", "-", "m/s^3", "mid", lambda p: p.j, weight=1.0),
        Term("goal", "-", "m", "end", lambda p: p.q - p.p.goal),
        Term("stop", "-", "m/s", "end", lambda p: ca.vertcat(p.v, p.a)),
        *extra,
    )
    rest = tuple(Bound(f"rest {k}", "-", "m", k, 0.0, 0.0, "start") for k in "qva")
    return Problem("move", (Phase("go", ("x",), N, duration, terms, (*rest, *bounds), **other),), (), {"goal": 1})


def flat_guess(duration=1.0) -> dict[str, PhaseGuess]:
    zero = np.zeros((N + 1, 1))
    return {"go": PhaseGuess(duration, zero, zero, zero)}


@pytest.fixture(scope="module")
def nlp():
    return Nlp(move())


def test_least_jerk_is_the_quintic(nlp):
    """With ever more pieces of constant jerk the answer tends to 10 s^3 - 15 s^4 + 6 s^5."""
    solution = nlp.solve({"goal": 2.0}, flat_guess())
    t = np.linspace(0, 1, 101)
    q, v, _ = (x[:, 0] for x in solution.phases["go"].sample(t))
    np.testing.assert_allclose(q, 2 * (10 * t**3 - 15 * t**4 + 6 * t**5), atol=2e-3)
    np.testing.assert_allclose(v, 2 * (30 * t**2 - 60 * t**3 + 30 * t**4), atol=1e-2)
    assert solution.statistics.objective == pytest.approx(4 * 720, rel=1e-2)  # int (60 - 360 s + 360 s^2)^2 = 720
    assert solution.statistics.status in GOOD_STATUSES and solution.statistics.residual < 1e-6


def test_sample_is_what_was_optimised(nlp):
    phase = nlp.solve({"goal": 1.0}, flat_guess()).phases["go"]
    for got, want in zip(phase.sample(phase.t), (phase.q, phase.v, phase.a), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-8)
    t = np.linspace(0, 1, 3001)
    q, v, a = (x[:, 0] for x in phase.sample(t))
    step = t[1] - t[0]
    np.testing.assert_allclose(np.diff(q) / step, (v[1:] + v[:-1]) / 2, atol=1e-5)
    np.testing.assert_allclose(np.diff(v) / step, (a[1:] + a[:-1]) / 2, atol=1e-4)


def test_warm_start_on_the_same_and_on_a_finer_mesh(nlp):
    first = nlp.solve({"goal": 1.0}, flat_guess())
    again = nlp.solve({"goal": 1.0}, first.guess())
    # the problem is a QP: from anywhere one step, or two where the first is not exact to the last digits
    assert again.statistics.iterations <= max(first.statistics.iterations, 2)
    assert again.statistics.objective == pytest.approx(first.statistics.objective, rel=1e-6)
    fine = first.guess({"go": 90})["go"]
    assert fine.q.shape == (91, 1)
    np.testing.assert_allclose(fine.q[::3], first.phases["go"].q, atol=1e-8)


def test_cost_shares_and_tightest_rows():
    wall = Term("wall", "-", "m/s", "node", lambda p: p.v, lower=-np.inf, upper=1.7, scale=2.0)
    heat = Term("heat", "-", "m/s^2", "node", lambda p: p.a, weight=0.1)
    solution = Nlp(move(wall, heat)).solve({"goal": 1.0}, flat_guess())
    shares = {row["name"]: row for row in solution.cost_shares}
    assert sum(row["share"] for row in shares.values()) == pytest.approx(1.0)
    assert sum(row["cost"] for row in shares.values()) == pytest.approx(solution.statistics.objective, rel=1e-9)
    report = {row["name"]: row for row in solution.constraint_report}
    assert report["wall"]["slack"] == pytest.approx(0.0, abs=1e-5) and report["wall"]["kind"] == "inequality"
    assert report["wall"]["value"] == pytest.approx(1.7, abs=1e-5)
    assert solution.phases["go"].v[report["wall"]["node"], 0] == pytest.approx(1.7, abs=1e-5)
    assert report["goal"]["kind"] == "equality" and "jerk chain" not in report


# what can be changed without building again ---------------------------------------------------------------------
def test_bounds_may_depend_on_parameters():
    cap = Bound("cap", "-", "m/s", "v", -np.inf, lambda p: 1.75 * p["goal"])
    row = Term("row", "-", "m/s^2", "node", lambda p: p.a, lower=lambda p: -5.5 * p["goal"], upper=np.inf)
    problem = move(row, bounds=(cap,))
    nlp = Nlp(problem)
    for goal in (0.5, 1.0, 2.0):
        phase = nlp.solve({"goal": goal}, flat_guess()).phases["go"]
        assert phase.v.max() == pytest.approx(1.75 * goal, abs=1e-5)
        assert phase.a.min() >= -5.5 * goal * (1 + 1e-6)
    free = Nlp(changed(problem, off=["cap"])).solve({"goal": 1.0}, flat_guess()).phases["go"].v.max()
    assert free > 1.8


def test_durations_may_depend_on_parameters():
    nlp = Nlp(move(duration=(lambda p: p["goal"], lambda p: 2 * p["goal"])))
    assert nlp.solve({"goal": 1.5}, flat_guess()).phases["go"].duration == pytest.approx(3.0, abs=1e-4)


def without(nlp, name: str):
    """The solution without one term."""
    return Nlp(changed(nlp.problem, off=[name])).solve({"goal": 1.0}, flat_guess())


def test_weights_and_switches(nlp):
    usual = nlp.solve({"goal": 1.0}, flat_guess()).statistics.objective
    for name in ("jerk", "go/jerk"):
        doubled = nlp.solve({"goal": 1.0}, flat_guess(), weights={name: 2.0}).statistics.objective
        assert doubled == pytest.approx(2 * usual, rel=1e-6)
    loose = without(nlp, "stop")
    assert loose.statistics.objective < 0.2 * usual and abs(loose.phases["go"].v[-1, 0]) > 0.5
    still = without(nlp, "go/goal")
    assert still.statistics.objective == pytest.approx(0.0, abs=1e-8)


def test_bounds_on_each_kind_of_variable():
    boxes = (
        Bound("jerk box", "-", "m/s^3", "j", -45.0, 45.0),
        Bound("far end", "-", "m", "q", 0.9, 1.1, "end"),
        Bound("inside", "-", "m", "q", -0.001, 1.05, "inner"),
    )
    phase = Nlp(move(bounds=boxes), None).solve({"goal": 1.0}, flat_guess()).phases["go"]
    assert np.abs(phase.j).max() <= 45.0 + 1e-5 and phase.q.min() >= -0.001 - 1e-8
    free = Nlp(move()).solve({"goal": 1.0}, flat_guess()).phases["go"]
    assert np.abs(free.j).max() > 45.0


# what is refused before solving ---------------------------------------------------------------------------------
def test_unknown_names_are_refused(nlp):
    sentence = (
        "weight or switch 'jrek': the problem 'move' has no such term; it has goal, jerk, rest a, rest q, rest v, stop"
    )
    assert refused(nlp.solve, {"goal": 1.0}, flat_guess(), weights={"jrek": 1.0}) == sentence


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        *((x, r"^move: parameters .* it takes \['goal'\]$") for x in ({}, {"goal": 1.0, "aim": 2.0}, {"aim": 1.0})),
        ({"goal": [1.0, 2.0, 3.0]}, None),
        ({"goal": "far"}, None),
    ],
)
def test_parameters_must_fit(nlp, parameters, sentence):
    with pytest.raises(InputError, match=sentence):
        nlp.solve(parameters, flat_guess())


def test_numbers_must_be_finite(nlp):
    for parameters, weights in (({"goal": np.nan}, {}), ({"goal": np.inf}, {}), ({"goal": 1.0}, {"jerk": np.nan})):
        said = f"move: {'weight' if weights else 'parameter'} {'jerk' if weights else 'goal'!r} is not finite"
        assert refused(nlp.solve, parameters, flat_guess(), weights=weights) == said


def test_references_must_be_given_known_and_fit():
    """A misspelt reference must not silently become zero."""
    track = Term("track", "-", "m", "node", lambda p: p.q - p.ref.r, weight=1.0)
    nlp, good = Nlp(move(track, references={"r": 1})), np.ones((1, N + 1))
    said = r"^move: reference 'r' of phase 'go' (has shape .*, must be \(1, 31\)|is not finite)$"
    for wrong in (np.zeros(N), np.zeros((1, N)), np.full((1, N + 1), np.nan)):
        with pytest.raises(InputError, match=said):
            nlp.solve({"goal": 1.0}, flat_guess(), references={"go": {"r": wrong}})
    for references in (None, {"go": {"s": good}}, {"gone": {"r": good}}):
        with pytest.raises(InputError):
            nlp.solve({"goal": 1.0}, flat_guess(), references=references)
    nlp.solve({"goal": 1.0}, flat_guess(), references={"go": {"r": good}})


def test_weight_of_a_constraint_is_refused(nlp):
    """It has none: silently doing nothing would mislead."""
    assert "stop" in refused(nlp.solve, {"goal": 1.0}, flat_guess(), weights={"stop": 5.0})


ZERO, NAN = np.zeros((N + 1, 1)), np.full((N + 1, 1), np.nan)
SHORT = f"guess 'q' of phase 'go' has shape (5, 1), must be ({N + 1}, 1)"
GUESSES = {
    "missing": ({}, "the guess has no phase 'go'"),
    "short": ({"go": PhaseGuess(1.0, np.zeros((5, 1)))}, SHORT),
    "nan": ({"go": PhaseGuess(1.0, NAN)}, "guess 'q' of phase 'go' is not finite"),
    "nan duration": ({"go": PhaseGuess(np.nan, ZERO, ZERO, ZERO)}, "guess of phase 'go' has the duration nan s"),
}


@pytest.mark.parametrize("kind", GUESSES)
def test_unusable_guesses(nlp, kind):
    assert refused(nlp.solve, {"goal": 1.0}, GUESSES[kind][0]) == f"move: {GUESSES[kind][1]}"


def test_bounds_that_exclude_each_other():
    nlp = Nlp(move(bounds=(Bound("cap", "-", "m", "q", lambda p: p["goal"], 9.0),)))
    with pytest.raises(JumplabError, match=r"cap|rest q"):  # the start is held at 0
        nlp.solve({"goal": 1.0}, flat_guess())
    nlp.solve({"goal": -1.0}, flat_guess())


# what fails while solving ---------------------------------------------------------------------------------------
def test_infeasible_names_the_terms_in_conflict():
    nlp = Nlp(move(Term("wall", "-", "m", "node", lambda p: p.q, lower=-np.inf, upper=0.5)))
    with pytest.raises(SolverError) as e:
        nlp.solve({"goal": 1.0}, flat_guess())
    assert e.value.stage == "move" and e.value.status not in GOOD_STATUSES and e.value.exit_code == 3
    named = " ".join(e.value.violations)
    assert ("go/goal" in named or "go/wall" in named) and "jerk chain" not in named
    assert str(e.value).startswith(f"move: no plan ({e.value.status} after ") and "\n" not in str(e.value)
    amounts = [float(line.split(" by ")[1].split()[0]) for line in e.value.violations]
    assert sum(amounts) == pytest.approx(0.5, rel=0.05)  # the goal lies half a metre behind the wall
    nlp.solve({"goal": 0.5}, flat_guess())  # and it can still be used


def test_infeasible_in_physical_units():
    """Violations are in the term's unit, whatever its scale: at 1 m/s^2, a quarter of the way is the most there is."""
    said = set()
    for scale in (0.1, 1.0, 20.0):
        term = Term("push", "-", "N", "node", lambda p: 10 * p.a, lower=-10.0, upper=10.0, scale=scale)
        with pytest.raises(SolverError) as e:
            Nlp(move(term)).solve({"goal": 1.0}, flat_guess())
        said.add(e.value.violations)
    ((line,),) = said
    missed = re.fullmatch(r"go/goal by (0\.\d+) m at t = 1\.000 s of the phase", line)
    assert 0.75 < float(missed[1]) < 0.78


def test_too_few_iterations_is_not_an_answer():
    wall = Term("wall", "-", "m/s", "node", lambda p: p.v, lower=-np.inf, upper=1.8)
    with pytest.raises(SolverError) as e:
        Nlp(move(wall), {"max_iter": 1}).solve({"goal": 1.0}, flat_guess())
    assert e.value.status == "Maximum_Iterations_Exceeded"
    assert "exists, but the search did not settle" in str(e.value)


ROOT = Term("root", "-", "m", "node", lambda p: ca.sqrt(p.q - 2), lower=0.0, upper=9.0)
TIP = Term("tip", "-", "m", "end", lambda p: ca.sqrt(p.q), lower=-np.inf, upper=9.0)
NO_NUMBERS = [
    (ROOT, "go/root at node 0, t = 0.000 s of the phase"),
    (TIP, f"go/tip at node {N}, t = 1.000 s of the phase"),
    (Term("log", "-", "m", "mid", lambda p: ca.log(p.q - 1), weight=1.0), "go/log"),
]


@pytest.mark.parametrize(("term", "named"), NO_NUMBERS)
def test_a_term_that_is_no_number_is_named(capfd, term, named):
    """Or whose slope is none; CasADi itself knows only row and column."""
    with pytest.raises(SolverError, match=r"go/.* has no finite value or slope at the initial guess;") as e:
        Nlp(move(term)).solve({"goal": 1.0}, flat_guess())
    assert e.value.violations == (named,) and e.value.status == "Invalid_Number_Detected"
    assert capfd.readouterr().err == ""


class Pretender:
    """A solver that says what it is told to say."""

    def __init__(self, solver, status, shift):
        self.solver, self.status, self.shift = solver, status, shift

    def __call__(self, **arguments):
        answer = self.solver(**arguments)
        return {**answer, "g": answer["g"] + self.shift}

    def stats(self):
        return {**self.solver.stats(), "return_status": self.status}


OTHERS = ("Search_Direction_Becomes_Too_Small", "Feasible_Point_Found", "User_Requested_Stop", "solve_succeeded",
          "Maximum_WallTime_Exceeded", "Not_Enough_Degrees_Of_Freedom", "")  # fmt: skip


@pytest.mark.parametrize("status", OTHERS)
def test_only_listed_statuses_are_believed(status):
    nlp = Nlp(move())
    nlp.solver = Pretender(nlp.solver, status, 0.0)
    with pytest.raises(SolverError) as e:
        nlp.solve({"goal": 1.0}, flat_guess())
    assert e.value.status == status


@pytest.mark.parametrize("status", GOOD_STATUSES)
def test_a_good_status_with_wrong_rows_is_not_believed(status):
    nlp = Nlp(move())
    sound = nlp.solver
    nlp.solver = Pretender(sound, status, 0.0)
    nlp.solve({"goal": 1.0}, flat_guess())
    for shift in (1e-3, np.nan):
        nlp.solver = Pretender(sound, status, shift)
        with pytest.raises(SolverError, match=rf"^move: no plan \({status} after \d+ iterations\): ") as e:
            nlp.solve({"goal": 1.0}, flat_guess())
        assert e.value.status == status


def test_a_rough_solution_is_for_who_asks_for_one():
    nlp = Nlp(move()).with_options({"acceptable_constr_viol_tol": 1e-2})
    sound = nlp.solver
    nlp.solver = Pretender(sound, GOOD_STATUSES[-1], 1e-3)
    assert 1e-4 < nlp.solve({"goal": 1.0}, flat_guess()).statistics.residual < 1e-2
    nlp.solver = Pretender(sound, GOOD_STATUSES[-1], 0.1)
    with pytest.raises(SolverError):
        nlp.solve({"goal": 1.0}, flat_guess())


def test_errors_carry_their_story():
    error = SolverError("no", stage="a", status="b", violations=("c",))
    assert (error.stage, error.status, error.violations, error.exit_code) == ("a", "b", ("c",), 3)
    assert isinstance(error, JumplabError)
