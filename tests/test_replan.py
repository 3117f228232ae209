"""Beginning with a known solution: multipliers from mesh to mesh, a warm solve, and a neighbouring target."""

from dataclasses import replace

import numpy as np
import pytest
from fixtures_core import jump, planner, refused
from test_solver import flat_guess, move
from test_transcription import assembled as assembled

from jumplab.auditing.audit import audit
from jumplab.ocp.nlp import GOOD_STATUSES, WARM, Nlp, PhaseGuess
from jumplab.ocp.posing import pack, pack_multipliers, unpack, unpack_multipliers
from jumplab.ocp.problem import Term
from jumplab.stages import planner as pipeline
from jumplab.task import JumpTask


def test_packing_and_unpacking_are_inverse(assembled):
    x = np.random.default_rng(0).uniform(0.5, 1.5, assembled.size)
    phases = unpack(assembled, x)
    again = {n: PhaseGuess(p.duration, p.q, p.v, p.a, p.z, p.constants) for n, p in phases.items()}
    packed = pack(assembled, again)
    for layout in assembled.layouts.values():  # jerks follow from the accelerations, so they are another matter
        for index in (layout.nodes, layout.constants):
            np.testing.assert_allclose(packed[index], x[index], rtol=1e-14)


def test_every_row_has_one_place(assembled):
    found = np.concatenate([rows.index.ravel() for rows in assembled.rows])
    np.testing.assert_array_equal(np.sort(found), np.arange(assembled.n_rows))
    assert all(len(rows.nodes) == len(rows.index) for rows in assembled.rows)


def test_multipliers_survive_on_their_own_mesh(assembled):
    rng = np.random.default_rng(1)
    lam_x, lam_g = rng.normal(size=assembled.size), rng.normal(size=assembled.n_rows)
    x, g = pack_multipliers(assembled, unpack_multipliers(assembled, lam_x, lam_g))
    np.testing.assert_allclose(g, lam_g, rtol=1e-14)
    for layout in assembled.layouts.values():
        np.testing.assert_allclose(x[layout.nodes], lam_x[layout.nodes], rtol=1e-14)
        np.testing.assert_array_equal(x[layout.constants], lam_x[layout.constants])


def test_multipliers_of_two_meshes_say_the_same():
    """Least jerk below a speed limit: what the limit is worth does not depend on the mesh, up to its own error.

    That error is of second order: 2.5 % between the two coarser meshes, and a quarter of it between the two finer ones.
    """
    found = {}
    for n in (30, 60, 120):
        wall = Term("wall", "-", "m/s", "node", lambda p: p.v, lower=-np.inf, upper=1.7)
        problem = move(wall)
        nlp = Nlp(replace(problem, phases=(replace(problem.phases[0], intervals=n),)))
        guess = {"go": PhaseGuess(1.0, np.zeros((n + 1, 1)))}
        found[n] = nlp.solve({"goal": 1.0}, guess), nlp
    share, values = found[60][0].multipliers.rows["go", "wall"]
    coarse = pack_multipliers(found[60][1].assembled, found[30][0].multipliers)[1]
    index = next(rows.index for rows in found[60][1].assembled.rows if rows.term.name == "wall")
    total = {n: f[0].multipliers.rows["go", "wall"][1].sum() / n for n, f in found.items()}
    assert total[60] == pytest.approx(total[120], rel=0.01) and total[60] > 1.0
    assert (total[30] - total[60]) / (total[60] - total[120]) == pytest.approx(4.0, rel=0.05)
    assert coarse[index].sum() == pytest.approx(total[60], rel=0.1)
    assert share[np.argmax(values[:, 0])] == pytest.approx(0.5, abs=0.1)


def test_a_warm_start_with_multipliers_is_short():
    wall = Term("wall", "-", "m/s", "node", lambda p: p.v, lower=-np.inf, upper=1.7)
    nlp = Nlp(move(wall))
    first = nlp.solve({"goal": 1.0}, flat_guess())
    again = nlp.with_options(WARM).solve({"goal": 1.0}, first.guess(), multipliers=first.multipliers)
    assert again.statistics.iterations <= first.statistics.iterations / 2
    assert again.statistics.objective == pytest.approx(first.statistics.objective, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", pipeline.METHODS)
def test_a_neighbouring_target(bhr, method):
    """From the plan for 0.95 m to 1.0 m: hardly dearer than from nothing, clean, and with far fewer iterations."""
    fresh = jump(1.0, 0.5, 0.0, method)
    again = planner().replan(jump(0.95, 0.5, 0.0, method), fresh.task)
    assert (again.method, again.task, again.joints) == (method, fresh.task, None)
    assert audit(again.tape, bhr, again.task).passed
    cost = [p.whole_body.solution.statistics.objective for p in (again, fresh)]
    assert cost[0] <= 1.01 * cost[1]
    assert again.whole_body.start == "neighbour" and len(again.whole_body.attempts) == 1
    assert again.whole_body.solution.statistics.status in GOOD_STATUSES
    spent = [sum(r.iterations for r in p.statistics if "joint" not in r.stage) for p in (again, fresh)]
    assert spent[0] < spent[1] / 2


def test_of_another_robot():
    stronger = jump(1.0, 0.5).robot.with_limits(effort=1.1)
    said = refused(planner().replan, replace(jump(1.0, 0.5), robot=stronger), JumpTask(0.9, 0.5))
    plans = f"the robot bhr ({stronger.hash}), not for bhr ({planner().robot.hash})"
    assert said == f"the previous plan is for {plans}; give a plan of this robot"
