"""From terms to a sparse program: every place, skip, scale and derivative, by hand and by CasADi's own means."""

import doctest
import re

import casadi as ca
import numpy as np
import pytest
from fixtures_core import refused, srmp_planner
from scipy.sparse import csc_matrix

from jumplab.errors import InputError
from jumplab.ocp import changed
from jumplab.ocp import problem as problem_words
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import chain
from jumplab.ocp.problem import Bound, Phase, Problem, Term


# the chain ------------------------------------------------------------------------------------------------------
def test_chain_is_exact_on_cubics():
    rng = np.random.default_rng(0)
    for _ in range(5):
        c = np.poly1d(rng.normal(size=4))
        t0, h = rng.normal(), rng.uniform(0.01, 0.5)
        derivatives = [np.polyder(c, k) if k else c for k in range(4)]
        got = chain(*(d(t0) for d in derivatives), h)
        np.testing.assert_allclose(got, [d(t0 + h) for d in derivatives[:3]], rtol=1e-12, atol=1e-12)


# a problem with everything in it --------------------------------------------------------------------------------
def _first_terms():
    return (
        Term("node cost", "-", "m", "node", lambda p: ca.vertcat(p.q[0] * p.v[1] + p.s, p.a[0] * p.c.k), weight=2.0),
        Term("mid cost", "-", "m", "mid", lambda p: p.j[0] * p.q[1] + p.s * p.duration, weight=0.5),
        Term("start cost", "-", "m", "start", lambda p: p.z[0] * p.q[0], weight=3.0),
        Term(
            "node row",
            "-",
            "m",
            "node",
            lambda p: ca.vertcat(p.q[0] ** 2 - p.ref.r[0], p.z[0] * p.v[0]),
            scale=4.0,
            skip=(1, 2),
        ),
        Term("track", "-", "m", "node", lambda p: ca.sin(p.q[1]) - p.ref.r[1] * p.p.m, weight=1.5),
        Term("mid row", "-", "m", "mid", lambda p: p.q[0] * p.q[1] * p.v[0], lower=-np.inf, upper=3.0),
        Term("drift", "-", "m", "interval", lambda a, b, h: b.z - a.z - h * a.q[0] * b.q[1] - a.j[1] * 1e-3, scale=2.0),
        Term("end row", "-", "m", "end", lambda p: p.q[0] - p.p.goal[1] * p.time),
    )


def toy() -> Problem:
    first = Phase(
        "one",
        ("x", "y"),
        5,
        (0.5, 2.0),
        _first_terms(),
        (Bound("rest", "-", "m", "v", 0.0, 0.0, "start"),),
        states=("w",),
        constants={"k": (-1.0, 1.0, 0.5)},
        references={"r": 2},
        scales={"q": [1.0, 2.0], "v": 3.0, "a": 10.0, "j": [100.0, 50.0], "z": 0.5},
    )
    second = Phase("two", ("u",), 3, (0.1, 1.0), (Term("jerk", "-", "m", "mid", lambda p: p.j, weight=1e-3),))
    joints = (
        Term(
            "meet", "-", "m", "problem", lambda e: e["one"].end.q[0] * e["one"].end.c.k - e["two"].start.q[0], scale=3.0
        ),
        Term("short", "-", "s", "problem", lambda e: e["one"].end.duration + e["two"].end.duration ** 2, weight=7.0),
    )
    return Problem("toy", (first, second), joints, {"goal": 2, "m": 1})


@pytest.fixture(scope="module")
def assembled():
    return Assembled(toy())


def data_vector(a: Assembled, rng) -> np.ndarray:
    """Random parameters, weights and references; true shares of the phases."""
    p = rng.normal(size=a.p_size)
    for name in a.layouts:
        share = node_data(a, p, name)[:, 0]
        share[:] = np.linspace(0, 1, len(share))
    return p


def node_data(a: Assembled, p: np.ndarray, name: str) -> np.ndarray:
    """A view on the share and the references of every node of a phase, one row per node."""
    k = 2 + list(a.layouts).index(name)
    return p[a.data_at[k] : a.data_at[k + 1]].reshape(len(a.layouts[name].nodes), -1)


def physical(a: Assembled, x, name):
    """Nodes, jerks and constants of one phase in physical units."""
    layout = a.layouts[name]
    phase = layout.phase
    nodes = x[layout.nodes] * phase.node_scales
    jerks = x[layout.jerks] * phase.scale("j")
    return nodes, jerks, x[layout.constants] * phase.constant_scales


def random_point(a: Assembled, seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=a.size), data_vector(a, rng), rng


def test_costs_by_hand(assembled):
    """Node and mid costs are sums over the phase, the others plain squares; weights are data."""
    x, p, _ = random_point(assembled, 1)
    nodes, jerks, (duration, k) = physical(assembled, x, "one")
    q, v, acc, z = nodes[:, :2], nodes[:, 2:4], nodes[:, 4:6], nodes[:, 6]
    n, m = 5, p[2]
    h, s = duration / n, np.linspace(0, 1, n + 1)
    refs = node_data(assembled, p, "one")[:, 1:]
    mq, _, _ = chain(q[:-1], v[:-1], acc[:-1], jerks, h / 2)
    _, two_jerks, (two_s,) = physical(assembled, x, "two")
    share = np.r_[0.5, np.ones(n - 1), 0.5]  # trapezoid
    want = {
        "node cost": h * share @ ((q[:, 0] * v[:, 1] + s) ** 2 + (acc[:, 0] * k) ** 2),
        "mid cost": h * np.sum((jerks[:, 0] * mq[:, 1] + (s[:-1] + 0.5 / n) * duration) ** 2),
        "start cost": (z[0] * q[0, 0]) ** 2,
        "track": h * share @ (np.sin(q[:, 1]) - refs[:, 1] * m) ** 2,
        "jerk": two_s / 3 * np.sum(two_jerks**2),
        "short": (duration + two_s**2) ** 2,
    }
    parts = assembled.cost_parts(x, p).full().ravel()
    names = [term.name for _, term in assembled.cost_terms]
    assert sorted(names) == sorted(want)
    np.testing.assert_allclose(parts, [want[name] for name in names], rtol=1e-12)
    weights = p[slice(*assembled.data_at[1:3])]
    assert float(assembled.nlp(x, p)[0]) == pytest.approx(weights @ parts, rel=1e-12)


@pytest.mark.parametrize("place", ["node", "mid"])
def test_running_costs_are_integrals(place):
    """Doubling the mesh leaves a running cost where it is, to second order: int_0^T (t / T)^2 dt = T / 3."""
    errors = []
    for n in (10, 20, 40):
        phase = Phase("one", ("x",), n, (1.0, 3.0), (Term("cost", "-", "1", place, lambda p: p.s, weight=1.0),))
        a = Assembled(Problem("toy", (phase,), (), {}))
        x, p = np.full(a.size, 2.0), data_vector(a, np.random.default_rng(0))
        errors.append(abs(float(a.cost_parts(x, p)) - 2.0 / 3))
    assert errors[0] < 0.01 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


def rows_of(assembled, g, name):
    """(node, component) -> value of one term's rows."""
    found = [rows for rows in assembled.rows if rows.term.name == name]
    return {(r.nodes[k], c): g[i] for r in found for (k, c), i in np.ndenumerate(r.index)}


def test_rows_by_hand(assembled):
    x, p, _ = random_point(assembled, 2)
    g = assembled.nlp(x, p)[1].full().ravel()
    nodes, jerks, (duration, k) = physical(assembled, x, "one")
    q, v, acc, z = nodes[:, :2], nodes[:, 2:4], nodes[:, 4:6], nodes[:, 6]
    h = duration / 5
    refs = node_data(assembled, p, "one")[:, 1:]
    mq, mv, _ = chain(q[:-1], v[:-1], acc[:-1], jerks, h / 2)
    skipped = rows_of(assembled, g, "node row")
    assert sorted(skipped) == [(node, i) for node in (1, 2, 3) for i in (0, 1)]  # one left out in front, two behind
    for (node, i), value in skipped.items():
        want = q[node, 0] ** 2 - refs[node, 0] if i == 0 else z[node] * v[node, 0]
        assert value == pytest.approx(want / 4.0, rel=1e-12)
    for (node, _), value in rows_of(assembled, g, "mid row").items():
        assert value == pytest.approx(mq[node, 0] * mq[node, 1] * mv[node, 0], rel=1e-12)
    for (node, _), value in rows_of(assembled, g, "drift").items():
        want = z[node + 1] - z[node] - h * q[node, 0] * q[node + 1, 1] - jerks[node, 1] * 1e-3
        assert value == pytest.approx(want / 2.0, rel=1e-12)
    assert rows_of(assembled, g, "end row") == {(5, 0): pytest.approx(q[5, 0] - p[1] * duration, rel=1e-12)}
    start = physical(assembled, x, "two")[0][0, 0]
    assert rows_of(assembled, g, "meet") == {(0, 0): pytest.approx((q[5, 0] * k - start) / 3.0, rel=1e-12)}
    assert len(rows_of(assembled, g, "mid row")) == len(rows_of(assembled, g, "drift")) == 5


def test_state_equation_is_the_chain(assembled):
    """The rows of the chain vanish exactly where each node follows from the one before."""
    x, p, rng = random_point(assembled, 3)
    for name, layout in assembled.layouts.items():
        _, jerks, constants = physical(assembled, x, name)
        step, nq = constants[0] / layout.phase.intervals, len(layout.phase.coordinates)
        state = rng.normal(size=(3, nq))
        for k in range(layout.phase.intervals + 1):
            place, scales = layout.nodes[k], layout.phase.node_scales
            x[place[: 3 * nq]] = state.ravel() / scales[: 3 * nq]
            if k < layout.phase.intervals:
                state = np.array(chain(*state, jerks[k], step))
    g = assembled.nlp(x, p)[1].full().ravel()
    defects = np.concatenate([g[r.index].ravel() for r in assembled.rows if r.term.name == "jerk chain"])
    assert len(defects) == 5 * 6 + 3 * 3 and np.abs(defects).max() < 1e-12


def derivatives_agree(a: Assembled, seeds, tolerance):
    """Gradient, Jacobian and Hessian of the assembled functions against CasADi's derivative of its value."""
    x, p = ca.MX.sym("x", a.size), ca.MX.sym("p", a.p_size)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", a.n_rows)
    f, g = a.nlp(x, p)
    grad, jac = ca.gradient(f, x), ca.jacobian(g, x)
    both = ca.Function("both", [x, p], [grad, jac])
    along = ca.MX.sym("along", a.size)
    slope = ca.gradient(lam_f * f + ca.dot(lam_g, g), x)
    product = ca.Function("product", [x, p, lam_f, lam_g, along], [ca.jtimes(slope, x, along)])
    for seed in seeds:
        rng = np.random.default_rng(seed)
        point, data = 0.5 + 0.2 * rng.normal(size=a.size), data_vector(a, rng)
        multipliers = rng.normal(), rng.normal(size=a.n_rows)
        want_grad, want_jac = both(point, data)
        close(a.grad_f(point, data)[1], want_grad, tolerance)
        close(a.jac_g(point, data)[1], want_jac, tolerance)
        upper = sparse(a.hess_lag(point, data, *multipliers))
        assert np.all(upper.tocoo().row <= upper.tocoo().col)
        full = upper + upper.T - csc_matrix(np.diag(upper.diagonal()))
        for _ in range(3):
            vector = rng.normal(size=a.size)
            want = product(point, data, *multipliers, vector).full().ravel()
            np.testing.assert_allclose(full @ vector, want, rtol=tolerance, atol=tolerance * np.abs(want).max())


def sparse(dm) -> csc_matrix:
    return csc_matrix((dm.nonzeros(), dm.row(), dm.colind()), shape=dm.shape)


def close(got, want, tolerance):
    difference, size = sparse(got) - sparse(want), max(1.0, np.abs(sparse(want)).max())
    assert np.abs(difference).max() <= tolerance * size


def test_derivatives_of_the_toy(assembled):
    derivatives_agree(assembled, (4, 5, 6), 1e-11)


def test_derivatives_of_stage_one():
    derivatives_agree(srmp_planner().nlp.assembled, (7,), 1e-10)


def test_jacobian_lists_no_entry_twice(assembled):
    for function in (assembled.jac_g.sparsity_out(1), assembled.hess_lag.sparsity_out(0)):
        pairs = list(zip(*function.get_triplet(), strict=True))
        assert len(pairs) == len(set(pairs))


def test_references_reach_their_node(assembled):
    """Changing the data of one node changes that node's rows and nothing else."""
    x, p, _ = random_point(assembled, 8)
    other = p.copy()
    node_data(assembled, other, "one")[2, 1] += 1.0  # reference r[0] of node 2
    difference = assembled.nlp(x, other)[1].full().ravel() - assembled.nlp(x, p)[1].full().ravel()
    (moved,) = np.flatnonzero(difference)
    assert moved == next(rows.index[1, 0] for rows in assembled.rows if rows.term.name == "node row")


# words ----------------------------------------------------------------------------------------------------------
def test_the_first_example_runs():
    assert doctest.testmod(problem_words).attempted >= 7
    assert doctest.testmod(problem_words).failed == 0


def test_places_are_checked():
    said = refused(Term, "lost", "-", "m", "nowhere", lambda p: p.q)
    assert said == ("term 'lost': at = 'nowhere', must be one of node, mid, interval, start, end, problem")


def test_table_lists_every_term_and_bound():
    problem = toy()
    rows = {(r["phase"], r["name"]): r for r in problem.table()}
    assert len(rows) == len(problem.terms()) + 1
    assert rows["one", "node cost"]["kind"] == "cost" and rows["one", "node cost"]["value"] == "weight 2"
    assert rows["one", "mid row"]["value"] == "-inf ... 3" and rows["one", "rest"]["kind"] == "bound"
    assert all(r["unit"] and r["equation"] for r in rows.values())


def test_terms_can_be_added_and_must_have_their_own_name():
    problem = changed(toy(), {"two": [Term("wall", "-", "m", "node", lambda p: p.q, lower=-1.0, upper=1.0)]})
    assert Assembled(problem).n_rows == Assembled(toy()).n_rows + 4
    assert "nowhere" in refused(changed, toy(), {"nowhere": [Term("wall", "-", "m", "node", lambda p: p.q)]})
    twin = Term("wall", "-", "m", "node", lambda p: p.v, lower=-5.0, upper=5.0)
    with pytest.raises(InputError, match="wall"):  # bounds are found by name: a second one would get the first one's
        changed(problem, {"two": [twin]})


def test_skip_is_for_constraints_at_nodes():
    sentence = "term 'x': skip = (2, 3) is only for constraints at 'node', not for a cost at 'node'; leave out skip"
    with pytest.raises(InputError, match=re.escape(sentence)):
        Term("x", "-", "m", "node", lambda p: p.q[0], weight=1.0, skip=(2, 3))
