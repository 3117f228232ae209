"""Phases that share nodes and constants, and coordinates that follow from terms at the nodes."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from test_transcription import data_vector, derivatives_agree

from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import BENT, chain
from jumplab.ocp.layout import layouts
from jumplab.ocp.nlp import Nlp, PhaseGuess
from jumplab.ocp.problem import Bound, Phase, Problem, Term

N = 24  # intervals of the motion in one piece
STEP = 1e-6  # of finite differences
VIA = {"via": (-5.0, 5.0, 0.5, "via")}  # a place that both halves know


# one motion, whole and in two halves --------------------------------------------------------------
def follows(p):
    """The second coordinate is the square of the first one, on three levels."""
    x, y = ca.vertsplit(p.q)
    vx, vy = ca.vertsplit(p.v)
    ax, ay = ca.vertsplit(p.a)
    return ca.vertcat(y - x**2, vy - 2 * x * vx, ay - 2 * vx**2 - 2 * x * ax)


def running(skip: int = 0) -> tuple[Term, ...]:
    """Terms that hold all along; at a first node that is shared the phase before has them."""
    return (
        Term("jerk", "-", "m/s^3", "mid", lambda p: p.j[0], weight=1.0),
        Term("acceleration", "-", "m/s^2", "node", lambda p: p.a, weight=20.0),
        Term("follows", "-", "m", "node", follows, skip=(skip, 0), identity=True),
    )


def reached(p):
    return p.q[0] - p.p.goal - p.c.via


FAVOURED = Term("favoured", "-", "m", "start", lambda p: p.c.via - 0.2, weight=3.0)
GOAL = Term("goal", "-", "m", "end", reached)
STOP = Term("stop", "-", "m/s", "end", lambda p: ca.vertcat(p.v[0], p.a[0]))
REST = tuple(Bound(f"rest {k}", "-", "m", k, 0.0, 0.0, "start") for k in "qva")
HOW = {"constants": VIA, "integrated": ("x",), "kind": "go"}


def whole() -> Problem:
    """From rest at 0 past an unknown place half-way to rest at the goal."""
    via = Term("via", "-", "m", "node", lambda p: p.q[0] - p.c.via, skip=(N // 2, N // 2))
    terms = *running(), via, FAVOURED, GOAL, STOP
    phase = Phase("go", ("x", "y"), N, (1.0, 1.0), terms, REST, **HOW)
    return Problem("move", (phase,), (), {"goal": 1})


def halves(shared: str = "qva") -> Problem:
    """The same in two phases."""
    via = Term("via", "-", "m", "end", lambda p: p.q[0] - p.c.via)
    first = *running(), via, FAVOURED
    second = *running(1), GOAL, STOP
    phases = (
        Phase("one", ("x", "y"), N // 2, (0.5, 0.5), first, REST, **HOW),
        Phase("two", ("x", "y"), N // 2, (0.5, 0.5), second, (), shared=shared, **HOW),
    )
    return Problem("move", phases, (), {"goal": 1})


def start(problem: Problem) -> dict[str, PhaseGuess]:
    """A straight way."""
    out, count = {}, len(problem.phases)
    for k, phase in enumerate(problem.phases):
        x = np.linspace(k / count, (k + 1) / count, phase.intervals + 1)
        zero = np.zeros((len(x), 2))
        out[phase.name] = PhaseGuess(1.0 / count, np.column_stack([x, x**2]), zero, zero)
    return out


@pytest.fixture(scope="module")
def solved():
    return [Nlp(problem).solve({"goal": 0.7}, start(problem)) for problem in (whole(), halves())]


def test_two_phases_with_a_shared_node_are_the_motion_in_one(solved):
    one, two = solved
    first, second = two.phases["one"], two.phases["two"]
    for k in "qva":
        joined = np.concatenate([getattr(first, k), getattr(second, k)[1:]])
        np.testing.assert_array_equal(getattr(first, k)[-1], getattr(second, k)[0])
        np.testing.assert_allclose(joined, getattr(one.phases["go"], k), atol=1e-5)
    assert two.statistics.objective == pytest.approx(one.statistics.objective, rel=1e-7)
    assert first.constants == second.constants
    assert first.constants == pytest.approx(one.phases["go"].constants, abs=1e-6)
    assert first.q[-1, 0] == pytest.approx(first.constants["via"], abs=1e-8)
    assert (two.statistics.variables, two.statistics.rows) == (1 + one.statistics.variables, one.statistics.rows)


def test_what_is_not_shared_may_jump(solved):
    problem = halves("qv")
    phases = Nlp(problem).solve({"goal": 0.7}, start(problem)).phases
    jump = np.abs(phases["two"].a[0] - phases["one"].a[-1]).max()
    assert jump > 0.1
    np.testing.assert_array_equal(phases["two"].v[0], phases["one"].v[-1])


def test_coordinates_that_follow_are_sampled_through_all_levels_of_their_nodes(solved):
    """Those that are integrated have a linear acceleration in between; the others miss little."""
    phase = solved[1].phases["two"]
    for mine, nodes in zip(phase.sample(phase.t), (phase.q, phase.v, phase.a), strict=True):
        np.testing.assert_allclose(mine, nodes, atol=1e-9)
    t = np.linspace(0, phase.duration, 200)
    q, v, a = phase.sample(t)
    k = np.minimum((t / phase.t[1]).astype(int), len(phase.j) - 1)
    exact = chain(*(x[k, 0] for x in (phase.q, phase.v, phase.a, phase.j)), t - phase.t[k])
    for mine, straight in zip((q, v, a), exact, strict=True):
        np.testing.assert_allclose(mine[:, 0], straight, atol=1e-6)
    off = follows(SimplePoint(q.T, v.T, a.T)).full().reshape(3, -1)
    assert np.all(np.abs(off).max(axis=1) < [1e-4, 2e-3, 0.1])


class SimplePoint:
    """Many points at once."""

    def __init__(self, q, v, a):
        self.q, self.v, self.a = (ca.DM(x) for x in (q, v, a))


# where the variables stand ------------------------------------------------------------------------
def pair() -> Problem:
    """A phase with jerks, and one that shares some of its node, a state and a constant with it."""
    first = Phase(
        "one",
        ("x", "y"),
        2,
        (0.5, 2.0),
        (Term("node", "-", "m", "node", lambda p: p.q[0] * p.c.k, weight=1.0),),
        states=("f",),
        constants={"k": (-1.0, 1.0, 0.5, "k")},
    )
    second = Phase(
        "two",
        ("y", "w"),
        2,
        (0.5, 2.0),
        (Term("node", "-", "m", "node", lambda p: p.q[0] * p.c.m, weight=1.0),),
        states=("f", "g"),
        constants={"k": (-1.0, 1.0, 0.5, "k"), "m": (0.0, 1.0, 1.0)},
        integrated=("w",),
        shared="qaz",
    )
    return Problem("pair", (first, second))


def test_shared_variables_have_one_place():
    one, two = layouts(pair()).values()
    assert one.constants.tolist() == [0, 1]  # duration, k
    assert one.nodes.tolist() == [[*range(2, 9)], [*range(11, 18)], [*range(20, 27)]]
    assert one.jerks.tolist() == [[9, 10], [18, 19]]
    assert two.constants.tolist() == [27, 1, 28]  # its own duration and m, the k of the first
    # y, its acceleration and f are those of the first one's end; w, the rates and g are new
    assert two.nodes[0].tolist() == [21, 29, 30, 31, 25, 32, 26, 33]
    assert two.nodes[1:].tolist() == [[*range(34, 42)], [*range(42, 50)]]
    assert two.jerks.shape == (2, 0)


def test_each_variable_that_is_not_shared_has_a_place_of_its_own():
    a = Assembled(pair())
    seen = []
    for layout in a.layouts.values():
        seen += [layout.constants, layout.nodes.ravel(), layout.jerks.ravel()]
    places, counts = np.unique(np.concatenate(seen), return_counts=True)
    assert places.tolist() == list(range(a.size)) and a.size == 50
    assert places[counts == 2].tolist() == [1, 21, 25, 26]


# derivatives --------------------------------------------------------------------------------------
def tangled() -> Problem:
    """Costs and rows of every place across shared nodes; a constant has two names in each phase."""

    def step(left, right, h):
        return right.z - left.z - h * left.q[0] * right.a[1] * left.j[0]

    terms = (
        Term("node cost", "-", "m", "node", lambda p: ca.vertcat(p.q[0] * p.v[1], p.c.k * p.a[0]), weight=2.0),
        Term("mid cost", "-", "m", "mid", lambda p: p.j * p.c.k * p.c.same, weight=0.5),
        Term("row", "-", "m", "node", lambda p: p.q[0] ** 2 * p.z[0] + p.c.k * p.c.same * p.q[1], scale=3.0),
        Term("step", "-", "m", "interval", step, scale=2.0),
        Term("end cost", "-", "m", "end", lambda p: ca.sin(p.q[0]) * p.duration, weight=1.5),
    )
    how = {"states": ("f",), "constants": {"k": (-1.0, 1.0, 0.5, "k"), "same": (-1.0, 1.0, 0.5, "k")}}
    how |= {"scales": {"q": [1.0, 2.0], "v": 3.0, "a": 10.0, "z": 0.5}, "integrated": ("x",)}
    one = Phase("one", ("x", "y"), 3, (0.5, 2.0), terms, **how)
    two = Phase("two", ("x", "y"), 2, (0.5, 2.0), terms, shared="qvaz", **how)
    joints = (
        Term("ends", "-", "m", "problem", lambda e: e["one"].end.q[0] * e["two"].start.q[0], scale=2.0),
        Term("both", "-", "m", "problem", lambda e: e["one"].end.c.k * e["two"].end.c.same ** 2, weight=0.7),
    )
    return Problem("tangled", (one, two), joints)


def test_derivatives_across_shared_nodes_and_constants():
    derivatives_agree(Assembled(tangled()), (0, 1), 1e-11)


def test_the_gauss_newton_hessian_is_exact_for_squares_of_straight_lines():
    """Also where a node is shared, and where two names are one constant."""
    problem = tangled()
    lines = (
        Term("node", "-", "m", "node", lambda p: p.q + p.a - 2 * p.c.k + 3 * p.c.same, weight=2.0),
        Term("end", "-", "m", "end", lambda p: p.q[0] - p.v[1] + p.z, weight=0.5),
    )
    phases = tuple(replace(p, terms=lines, duration=(1.0, 1.0)) for p in problem.phases)
    a, rng = Assembled(replace(problem, phases=phases, joints=())), np.random.default_rng(3)
    x, p = rng.normal(size=a.size), data_vector(a, rng)
    exact = a.hess_lag(x, p, 1.0, np.zeros(a.n_rows)).full()
    durations = [layout.constants[0] for layout in a.layouts.values()]
    free = np.setdiff1d(np.arange(a.size), durations)
    found = a.gauss_newton(x, p).full()
    np.testing.assert_allclose(found[np.ix_(free, free)], exact[np.ix_(free, free)], atol=1e-12)


@pytest.mark.parametrize(("count", "straight"), [(3, False), (BENT, True)])
def test_a_cost_of_very_many_operations_counts_as_straight(count, straight):
    """Its second derivatives are left out of the exact Hessian, those of a small one are not."""

    def waves(e):
        q = e["one"].end.q[0]
        return sum(ca.sin(k * q) for k in range(1, 1 + count)) / count

    large = Term("waves", "-", "m", "problem", waves, weight=2.0)
    problem = tangled()
    a = Assembled(replace(problem, phases=tuple(replace(p, terms=()) for p in problem.phases), joints=(large,)))
    rng = np.random.default_rng(5)
    x, p = 0.5 + 0.1 * rng.normal(size=a.size), data_vector(a, rng)
    exact = a.hess_lag(x, p, 1.0, np.zeros(a.n_rows)).full()
    assert np.abs(exact).max() > 0
    assert np.allclose(exact, a.gauss_newton(x, p).full(), atol=1e-12) == straight


# functions ----------------------------------------------------------------------------------------
def test_phases_of_one_kind_share_their_functions():
    """Whatever their names, intervals, bounds, and what they share; another kind has its own."""
    problem = halves()
    one, two = (replace(p, terms=running()) for p in problem.phases)
    third = replace(two, name="three", intervals=3, bounds=REST, terms=running(1))
    other = replace(two, name="four", kind="stay")
    a = Assembled(replace(problem, phases=(one, two, third, other)))
    made = {p.name: [] for p in a.problem.phases}
    for part, functions in zip(a.parts, a.functions, strict=True):
        made[part.owner].append(functions)
    one, two, third, other = made.values()
    for alike in (two, third):
        assert len(alike) == 2 and all(x is y for x, y in zip(alike, one, strict=True))
    assert not any(x is y for x, y in zip(other, one, strict=True))
    counts = [rows.index.size for rows in a.rows if rows.term.name == "follows"]
    assert counts == [39, 39, 9, 39]  # of the third one's first node the row is left out
