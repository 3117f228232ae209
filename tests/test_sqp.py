"""Gauss-Newton steps in the order of time: the same derivatives in other places, and where a few steps lead."""

import casadi as ca
import numpy as np
import pytest
from test_solver import flat_guess, move
from test_transcription import random_point, toy

from jumplab.errors import SolverError
from jumplab.ocp.assembly import Assembled, Posed
from jumplab.ocp.nlp import Nlp
from jumplab.ocp.problem import Term
from jumplab.ocp.sqp import MET, GaussNewton, TimeOrder
from jumplab.robot import Robot
from jumplab.stages.srmp import SrmpPlanner
from jumplab.stages.whole_body import Mesh, WholeBodyPlanner


def symmetric(upper: ca.DM) -> np.ndarray:
    upper = np.triu(upper.full())
    return upper + np.triu(upper, 1).T


@pytest.fixture(scope="module", params=["move", "SRMP", "whole body"])
def assembled(request):
    if request.param == "move":
        return Assembled(move())
    if request.param == "SRMP":
        return SrmpPlanner(Robot.load()).nlp.assembled
    return WholeBodyPlanner(Robot.load(), Mesh(3, 2, 4), refine=False).nlp.assembled


def in_order(a: Assembled, order: TimeOrder, x, p):
    """Jacobian and Hessian in the order of time, as numbers."""
    jac, hess = ca.MX.sym("jac", a.jac_g.nnz_out(1)), ca.MX.sym("hess", a.gauss_newton.nnz_out(0))
    put = ca.Function("put", [jac, hess], [order.jacobian(jac), order.hessian(hess)])
    values = a.jac_g(x, p)[1].nonzeros(), a.gauss_newton(x, p).nonzeros()
    return [y.full() for y in put(*values)]


def test_a_step_means_the_same_in_the_order_of_time(assembled):
    """J d and d H d do not depend on the order, and links of copies are met by copies."""
    order, (x, p, rng) = TimeOrder(assembled), random_point(assembled, 4)
    jac, hess = in_order(assembled, order, x, p)
    step = rng.normal(size=assembled.size)
    copies = step[order.source]
    rows = jac @ copies
    local = np.flatnonzero(order.local)
    np.testing.assert_allclose(rows[order.place[local]], (assembled.jac_g(x, p)[1].full() @ step)[local], atol=1e-9)
    np.testing.assert_allclose(rows[order.links[:, 0]], 0.0, atol=1e-12)
    own = symmetric(assembled.gauss_newton(x, p))
    assert copies @ hess @ copies == pytest.approx(step @ own @ step, rel=1e-9)


def test_every_row_and_variable_has_its_place(assembled):
    order = TimeOrder(assembled)
    np.testing.assert_array_equal(order.source[order.copy], np.arange(assembled.size))
    places = np.concatenate([order.place[order.local], order.links[:, 0]])
    np.testing.assert_array_equal(np.sort(places), np.arange(order.n_rows))
    assert len(order.source) == sum(order.nx) + sum(order.nu)
    assert order.n_rows == sum(order.nx[1:]) + sum(order.ng)


def test_a_variable_that_follows_from_nothing_is_refused():
    """In the toy problem a row is nonlinear in the next node, so it is no link."""
    with pytest.raises(ValueError, match="toy: nothing says what a variable of stage 1 follows from"):
        TimeOrder(Assembled(toy()))


def test_what_joins_far_nodes_is_left_out():
    order = TimeOrder(SrmpPlanner(Robot.load()).nlp.assembled)
    assert [order.a.rows[i].term.name for i in np.flatnonzero(~order.local)] == ["symmetric landing"]


def test_the_held_hessian_is_that_and_a_little_of_each_variable(assembled):
    x, p, rng = random_point(assembled, 6)
    rows, hold = rng.normal(size=assembled.n_rows), 0.3
    held = symmetric(assembled.held_hessian(hold)(x, p, 2.0, rows))
    own = symmetric(assembled.gauss_newton(x, p))
    np.testing.assert_allclose(held, 2.0 * own + hold * np.eye(assembled.size), atol=1e-9 * np.abs(own).max())


def test_both_hessians_lead_to_the_same_minimum():
    nlp = Nlp(move())
    exact = nlp.solve({"goal": 1.0}, flat_guess())
    held = nlp.with_options({}, hold=0.1).solve({"goal": 1.0}, flat_guess())
    assert held.statistics.objective == pytest.approx(exact.statistics.objective, rel=1e-5)
    assert nlp.with_options({}).solve({"goal": 1.0}, flat_guess()).statistics.iterations == exact.statistics.iterations


def test_gauss_newton_is_the_hessian_without_curvature(assembled):
    """Sums of squares: 2 J^T W J, never indefinite; J by differences of the costs is too rough, so by the parts."""
    x, p, _ = random_point(assembled, 5)
    own = symmetric(assembled.gauss_newton(x, np.abs(p)))
    x[[layout.constants[0] for layout in assembled.layouts.values()]] = 1.0  # durations are positive
    own = symmetric(assembled.gauss_newton(x, np.abs(p)))
    assert np.linalg.eigvalsh(own)[0] > -1e-8 * np.abs(own).max()


def test_of_linear_residuals_it_is_the_hessian():
    nlp = Nlp(move(duration=(1.0, 1.0)))
    a, (x, p, _) = nlp.assembled, random_point(nlp.assembled, 6)
    full = symmetric(a.hess_lag(x, p, 1.0, np.zeros(a.n_rows)))
    free = np.setdiff1d(np.arange(a.size), [layout.constants[0] for layout in a.layouts.values()])
    at = np.ix_(free, free)
    np.testing.assert_allclose(symmetric(a.gauss_newton(x, p))[at], full[at], atol=1e-9)


def test_a_linear_quadratic_problem_takes_one_step():
    """Least jerk from rest to rest: with its duration fixed the QP is the problem."""
    nlp = Nlp(move(duration=(1.0, 1.0)))
    near, exact = nlp.gauss_newton_steps({"goal": 2.0}, flat_guess()), nlp.solve({"goal": 2.0}, flat_guess())
    assert near.statistics.status == "Approached" and near.statistics.residual < 1e-3
    np.testing.assert_allclose(near.phases["go"].q, exact.phases["go"].q, atol=2e-3)


def test_a_start_without_numbers_is_refused():
    nlp = Nlp(move())
    method, a = GaussNewton(nlp.assembled), nlp.assembled
    wide = np.full(a.size, -np.inf), np.full(a.size, np.inf)
    rows = np.zeros(a.n_rows), np.zeros(a.n_rows)
    with pytest.raises(SolverError, match="step 1 of the approach is no number"):
        method.steps(Posed(np.full(a.size, np.nan), np.ones(a.p_size), wide, rows))


# beside a solution ------------------------------------------------------------------------------------------------
def test_steps_beside_a_solution_meet_every_row():
    """A goal moved by a tenth: met to the last digits, at hardly more than the least cost."""
    nlp = Nlp(move())
    first, best = nlp.solve({"goal": 2.0}, flat_guess()), nlp.solve({"goal": 2.2}, flat_guess())
    found = nlp.settled({"goal": 2.2}, first.guess())
    assert found.statistics.status == "Settled" and found.statistics.iterations <= 3
    assert found.statistics.residual <= MET
    assert found.phases["go"].q[-1, 0] == pytest.approx(2.2, abs=1e-5)
    assert best.statistics.objective * (1 - 1e-6) <= found.statistics.objective <= 1.02 * best.statistics.objective


def test_at_the_solution_nothing_moves():
    nlp = Nlp(move())
    best = nlp.solve({"goal": 2.0}, flat_guess())
    again = nlp.settled({"goal": 2.0}, best.guess())
    np.testing.assert_allclose(again.phases["go"].q, best.phases["go"].q, atol=1e-4)
    assert again.statistics.objective == pytest.approx(best.statistics.objective, rel=1e-4)


def test_rows_that_cannot_be_met_are_told():
    nlp = Nlp(move(Term("wall", "-", "m", "node", lambda p: p.q, lower=-np.inf, upper=1.5)))
    first = nlp.solve({"goal": 1.0}, flat_guess())
    with pytest.raises(
        SolverError, match=r"^move: rows are still off by \d\.\de[-+]\d\d \(scaled\) after 4 steps from a"
    ):
        nlp.settled({"goal": 2.0}, first.guess())


def test_other_weights_are_noticed():
    nlp = Nlp(move())
    first = nlp.solve({"goal": 2.0}, flat_guess())
    name = nlp.assembled.cost_terms[0][1].name
    assert nlp.weighs_as(first, {}) and not nlp.weighs_as(first, {name: 7.0})
