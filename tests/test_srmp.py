"""Stage 1: launch and flight that fit together, named terms that do what they say, and the exact case of the flight."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures_core import pendulum, refused, srmp_planner
from paper.srmp_printed import SYMMETRIC

from jumplab.errors import SolverError
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.srmp import SrmpPlanner, SrmpSettings, build_problem
from jumplab.stages.srmp.problem import GAUSS, flight_terms
from jumplab.task import JumpTask

TARGETS = [(1.0, 0.5, 0.0), (0.0, 0.4, 0.0), (0.6, 0.5, 0.3)]
G, MASS = 9.8, 42.0
SETTINGS = SrmpSettings()


@pytest.fixture(params=TARGETS, ids=str)
def plan(request):
    return pendulum(*request.param)


# the flight's quadrature ----------------------------------------------------------------------------------------
def turn(rho, L, T, intervals):
    """Rotation by the terms of stage 1 over a given rho(t): (value, rate, acceleration, jerk) as a function of t."""
    rotation = next(t for t in flight_terms(SETTINGS) if t.name == "rotation").expression
    step, total = T / intervals, 0.0
    for k in range(intervals):
        q, v, a, j = (np.array(x) for x in rho(k * step))
        left = SimpleNamespace(q=q, v=v, a=a, j=j, z=0.0, c=SimpleNamespace(L=L))
        total -= float(rotation(left, SimpleNamespace(z=0.0), step))  # z' - z - step * sum = 0
    return total


def test_exact_case():
    """rho = 2 - 1.5 t, L = 3, T = 0.6: theta = -2 ln 0.55."""
    assert turn(lambda t: (2 - 1.5 * t, -1.5, 0.0, 0.0), 3.0, 0.6, 40) == pytest.approx(1.1956740015, abs=1e-10)


def test_constant_inertia_turns_steadily():
    assert turn(lambda t: (4.0, 0.0, 0.0, 0.0), -5.0, 0.6, 1) == pytest.approx(-0.75, abs=1e-14)


def test_quadrature_is_of_sixth_order():
    assert sum(weight for _, weight in GAUSS) == pytest.approx(1.0, abs=1e-15)
    for power in range(6):
        assert sum(w * s**power for s, w in GAUSS) == pytest.approx(1 / (power + 1), abs=1e-15)
    coarse, fine = (
        abs(turn(lambda t: (2 - 1.5 * t, -1.5, 0.0, 0.0), 3.0, 0.6, n) + 2 * math.log(0.55)) for n in (2, 4)
    )
    assert coarse / fine > 40  # 2^6, roughly


def test_jerk_of_the_inertia_counts():
    rho = np.poly1d([30.0, -20.0, 3.0, 4.0])
    rates = [rho, rho.deriv(1), rho.deriv(2), rho.deriv(3)]
    t = np.linspace(0, 0.6, 60001)
    want = np.trapezoid(2.0 / rho(t), t)
    assert turn(lambda s: [r(s) for r in rates], 2.0, 0.6, 20) == pytest.approx(want, abs=1e-9)


# physics of a plan ----------------------------------------------------------------------------------------------
def test_iterations(plan):
    assert plan.solution.statistics.iterations < 45
    assert plan.solution.statistics.residual < 1e-4


def test_launch_starts_at_rest_in_the_stance(plan):
    launch, start = plan.launch, plan.reach.start
    np.testing.assert_allclose(launch.coordinates[0], start, atol=1e-7)
    np.testing.assert_allclose(launch.com_velocity[0], 0, atol=1e-7)
    np.testing.assert_allclose(launch.com_acceleration[0], 0, atol=1e-6)
    assert launch.cop_x[0] == pytest.approx(launch.com[0, 0], abs=1e-6)  # SL-P3
    assert launch.F_z[0] == pytest.approx(MASS * G, rel=1e-6)


def test_takeoff_has_no_wrench(plan):
    launch = plan.launch
    assert launch.com_velocity[-1, 1] == pytest.approx(plan.task.takeoff_speed, abs=1e-4)  # SL-E2
    assert abs(launch.F_x[-1]) < 0.1 and abs(launch.F_z[-1]) < 0.1 and abs(launch.L_rate[-1]) < 0.1
    np.testing.assert_allclose(launch.com_acceleration[-1], [0, -G], atol=3e-3)


def test_ground_force_is_admissible(plan):
    launch = plan.launch
    loaded = launch.F_z > 100.0
    assert launch.F_z.min() > -1.0
    assert np.abs(launch.F_x[loaded] / launch.F_z[loaded]).max() < SETTINGS.friction + 0.01
    assert launch.cop_x[loaded].min() > plan.reach.cop[0] and launch.cop_x[loaded].max() < plan.reach.cop[1] + 0.01
    toe = (launch.t > plan.launch_s - plan.toe_s) & loaded
    np.testing.assert_allclose(launch.cop_x[toe], plan.reach.cop[1], atol=0.01)  # heel up: CoP at the toe


def test_launch_is_consistent(plan):
    """Rates are derivatives, forces are m (c'' + g), the CoP is the paper's."""
    launch = plan.launch
    step = launch.t[1] - launch.t[0]
    sizes = {"com": 1.0, "com_velocity": 10.0, "L": 50.0, "rho": 20.0, "rho_rate": 200.0}
    rates = {"com": "com_velocity", "com_velocity": "com_acceleration", "L": "L_rate", "rho": "rho_rate"}
    for name, size in sizes.items():
        value, rate = getattr(launch, name), getattr(launch, rates.get(name, "rho_accel"))
        middle = (rate[1:] + rate[:-1]) / 2
        np.testing.assert_allclose(np.diff(value, axis=0) / step, middle, atol=1e-2 * size)
    np.testing.assert_allclose(launch.F_x, MASS * launch.com_acceleration[:, 0], atol=1e-8)
    np.testing.assert_allclose(launch.F_z, MASS * (launch.com_acceleration[:, 1] + G), atol=1e-8)
    up = launch.F_z > 1.0
    printed = launch.com[:, 0] - (launch.com[:, 1] * launch.F_x + launch.L_rate) / np.where(up, launch.F_z, 1.0)
    np.testing.assert_allclose(launch.cop_x[up], printed[up], rtol=1e-9, atol=1e-9)


def test_momentum_theorem_over_the_launch(plan):
    """Impulse of the ground force = change of momentum, and of its moment = change of L."""
    launch = plan.launch
    impulse = [np.trapezoid(f, launch.t) for f in (launch.F_x, launch.F_z - MASS * G, launch.L_rate)]
    want = [*(MASS * launch.com_velocity[-1]), launch.L[-1]]
    np.testing.assert_allclose(impulse, want, atol=0.3)


def test_inertia_stays_within_the_robots_envelope(plan):
    launch, envelope = plan.launch, plan.reach
    length = launch.coordinates[:, 1]
    low, high = (np.polyval(fit, length) for fit in (envelope.inertia_low_fit, envelope.inertia_high_fit))
    assert np.all(launch.rho > low - 0.01) and np.all(launch.rho < high + 0.01)
    assert plan.flight.rho.min() > envelope.inertia[0] and plan.flight.rho.max() < envelope.inertia[1]
    assert np.all(length > envelope.length[0] - 3e-3) and np.all(length < envelope.length[1] + 3e-3)
    assert np.all(launch.posture > envelope.posture[0] - 1e-3) and np.all(launch.posture < envelope.posture[1] + 1e-3)


def test_flight_continues_the_launch(plan):
    launch, flight = plan.launch, plan.flight
    for name, tolerance in (("com", 1e-4), ("com_velocity", 1e-4), ("L", 1e-3), ("rho", 1e-4), ("rho_rate", 3e-3),
                            ("rho_accel", 3e-2), ("lean", 1e-4)):  # SF-L1..L4  # fmt: skip
        np.testing.assert_allclose(getattr(flight, name)[0], getattr(launch, name)[-1], atol=tolerance, err_msg=name)


def test_flight_is_a_parabola_with_constant_momentum(plan):
    flight = plan.flight
    t = flight.t[:, None]
    parabola = flight.com[0] + t * flight.com_velocity[0] - np.array([0.0, G / 2]) * t**2
    np.testing.assert_allclose(flight.com, parabola, atol=1e-12)
    np.testing.assert_array_equal(flight.L, flight.L[0])
    np.testing.assert_allclose(flight.com[:, 1].max() - flight.com[0, 1], plan.task.height_m, atol=1e-3)


def test_flight_turns_by_its_momentum(plan):
    """theta' = L / rho, integrated here by another rule."""
    flight = plan.flight
    rotation = np.trapezoid(flight.L / flight.rho, flight.t)
    assert flight.lean[-1] - flight.lean[0] == pytest.approx(rotation, abs=1e-4)
    step = flight.t[1] - flight.t[0]
    middle = flight.L[0] / ((flight.rho[1:] + flight.rho[:-1]) / 2)
    np.testing.assert_allclose(np.diff(flight.lean) / step, middle, atol=5e-3)


def test_flight_time_from_both_heights(plan):
    """Reading 7: t_f = (v + sqrt(v^2 - 2 g dz)) / g with the plan's own CoM heights."""
    rise = plan.flight.com[-1, 1] - plan.flight.com[0, 1]
    assert plan.flight_s == pytest.approx(plan.task.flight_time(rise), abs=1e-3)


def test_lands_where_asked(plan):
    flight, task = plan.flight, plan.task
    sole = flight.com[-1] + flight.foot_com[-1]
    np.testing.assert_allclose(sole, [task.distance_m, task.platform_m], atol=1e-4)
    np.testing.assert_allclose(flight.com[0] + flight.foot_com[0], 0, atol=1e-4)  # and leaves from the pivot
    ahead = flight.foot_com[-1, 0] - SETTINGS.capture_offset_m - SETTINGS.capture_slope_s * flight.com_velocity[-1, 0]
    assert SETTINGS.capture_window_m[0] - 1e-4 < ahead < SETTINGS.capture_window_m[1] + 1e-4


def test_foot_of_the_flight_is_consistent(plan):
    flight = plan.flight
    step = flight.t[1] - flight.t[0]
    middle = (flight.foot_com_rate[1:] + flight.foot_com_rate[:-1]) / 2
    difference = np.diff(flight.foot_com, axis=0) / step
    np.testing.assert_allclose(difference, middle, atol=0.02 + 0.01 * np.abs(middle).max())


def test_forward_jumps_turn_backward(plan):
    if plan.task.distance_m > 0.3:
        assert plan.flight.L[0] < 0 and plan.flight.lean[0] > 0 > plan.flight.lean[-1]


def test_mirrored_target_reverses_the_travel():
    there, back = pendulum(0.4, 0.3), pendulum(-0.4, 0.3)
    assert there.flight.com_velocity[0, 0] > 0 > back.flight.com_velocity[0, 0]


@pytest.mark.parametrize("turns", [-1, 1])
def test_flips_turn_the_whole_way(turns):
    plan = srmp_planner().plan(JumpTask(0.0, 0.6, rotation_rad=2 * math.pi * turns))
    turned = np.trapezoid(plan.flight.L / plan.flight.rho, plan.flight.t)
    assert turned == pytest.approx(2 * math.pi * turns, abs=0.6)
    assert np.sign(plan.flight.L[0]) == turns
    np.testing.assert_allclose(plan.flight.com[-1] + plan.flight.foot_com[-1], [0.0, 0.0], atol=1e-4)


def test_other_gravity():
    task = JumpTask(0.3, 0.3, gravity=7.0)
    plan = srmp_planner().plan(task)
    np.testing.assert_allclose(plan.launch.com_acceleration[-1], [0, -7.0], atol=3e-3)
    assert plan.launch.F_z[0] == pytest.approx(MASS * 7.0, rel=1e-6)
    assert plan.flight_s == pytest.approx(task.flight_time(plan.flight.com[-1, 1] - plan.flight.com[0, 1]), abs=1e-3)


# terms ----------------------------------------------------------------------------------------------------------
def test_every_row_of_the_table_is_filled(bhr):
    table = build_problem(bhr, envelope=srmp_planner().reach).table()
    assert all(row["unit"] and row["equation"] and row["value"] for row in table)


def test_costs_are_listed_with_their_shares(plan):
    rows = plan.solution.cost_shares
    assert sum(row["share"] for row in rows) == pytest.approx(1.0)
    assert {"jerk", "CoM velocity", "turn", "launch time"} <= {row["name"] for row in rows}
    total = sum(row["cost"] for row in rows)
    assert all(row["cost"] > -1e-12 and row["share"] == pytest.approx(row["cost"] / total) for row in rows)
    tight = {(r["phase"], r["name"]): r for r in plan.solution.constraint_report}
    assert tight["toe", "rod force zero"]["kind"] == "equality" and abs(tight["toe", "rod force zero"]["slack"]) < 0.1
    assert all(r["slack"] > -1e-3 * max(1.0, abs(r["value"])) - 0.05 for r in tight.values())


TARGET = JumpTask(0.5, 0.3)


def freed(*off):
    """The plan without some terms."""
    return SrmpPlanner(Robot.load(), keep=True, changes=StageChanges(off=off)).plan(TARGET)


@pytest.mark.parametrize("name, measure", [
    ("turn", lambda p: np.trapezoid(p.launch.coordinates[:, 2] ** 2, p.launch.t)),
    ("CoM velocity", lambda p: np.trapezoid((p.launch.com_velocity**2).sum(1), p.launch.t)),
    ("L rate", lambda p: np.trapezoid(p.launch.L_rate**2, p.launch.t)),
    ("launch time", lambda p: p.launch_s),
])  # fmt: skip
def test_reweighted_terms_shrink(name, measure):
    usual = pendulum(0.5, 0.3)
    weight = next(row["weight"] for row in usual.solution.cost_shares if row["name"] == name)
    assert measure(srmp_planner().plan(TARGET, weights={name: 30 * weight})) < measure(usual) - 1e-6


def test_switched_off_constraints_free_the_plan():
    usual = pendulum(0.5, 0.3)
    for name in ("friction", "leg force", "capture window"):
        free = freed(name)
        assert free.solution.statistics.objective <= usual.solution.statistics.objective * (1 + 1e-5), name
    fast = freed("take-off speed")
    assert abs(fast.launch.com_velocity[-1, 1] - usual.task.takeoff_speed) > 0.05


def test_papers_symmetric_landing_instead_of_the_window(bhr):
    changes = StageChanges({"": (SYMMETRIC,)}, off=("capture window",))
    plan = SrmpPlanner(bhr, changes=changes).plan(TARGET)
    assert plan.flight.lean[-1] + plan.flight.lean[0] == pytest.approx(0.0, abs=1e-6)  # SF-E1
    assert abs(pendulum(0.5, 0.3).flight.lean[[0, -1]].sum()) > 0.01


def test_zero_wrench_needs_all_three():
    for name in ("rod force zero", "L rate zero"):
        plan = freed(name)
        left = abs(plan.launch.F_z[-1]) + abs(plan.launch.F_x[-1]) + abs(plan.launch.L_rate[-1])
        assert left > 1.0, name


# mesh, settings, failure ----------------------------------------------------------------------------------------
def test_mesh_converges(bhr):
    """40 intervals per phase, halved twice: second order in the cost; final speed, place and L settle to 1e-3."""
    ends, costs = [], []
    for factor in (1, 2, 4):
        intervals = tuple(factor * n for n in SETTINGS.intervals)
        plan = SrmpPlanner(bhr, replace(SETTINGS, intervals=intervals)).plan(TARGET)
        launch = plan.launch
        ends.append(np.array([launch.L[-1], *launch.com_velocity[-1], *launch.com[-1]]))
        costs.append(plan.solution.statistics.objective)
    last = np.abs(ends[2] - ends[1])
    assert np.all(last < 1e-3 * np.maximum(1.0, np.abs(ends[2]))), last
    assert 3.0 < (costs[0] - costs[1]) / (costs[1] - costs[2]) < 5.0  # 4 for second order


def test_settings_are_read(bhr):
    slippery = SrmpPlanner(bhr, replace(SETTINGS, friction=0.25)).plan(JumpTask(0.5, 0.3)).launch
    loaded = slippery.F_z > 100.0
    assert np.abs(slippery.F_x[loaded] / slippery.F_z[loaded]).max() < 0.26


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "term"),
    [
        ((2.9, 0.1), r"(jump length|take-off speed|touchdown height)"),
        ((0.6, 0.3, 0.9), r"touchdown height"),  # a rise of 0.3 m cannot land on 0.9 m, whatever the legs do
        ((0.0, 1.2), r"take-off speed"),
    ],
)
def test_beyond_the_robot_is_refused_with_the_terms_in_conflict(target, term):
    with pytest.raises(SolverError, match=term) as e:
        srmp_planner().plan(JumpTask(*target))
    sentence = str(e.value)
    assert "\n" not in sentence and any(c.isdigit() for c in sentence) and e.value.violations
    # what only says that the motion is one motion is no limit that anybody could relax
    assert not any(name in sentence for name in ("jerk chain", " link", "ballistic", "rotation"))


@pytest.mark.slow
def test_just_beyond_the_robot_is_refused():
    assert "take-off speed by " in refused(srmp_planner().plan, JumpTask(0.53, 0.67, -0.17), by=SolverError)
