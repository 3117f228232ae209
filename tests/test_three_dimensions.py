"""Stages 1 and 2 out of the plane: mechanics of the pendulum, mirrored targets, momentum kept, the steps chained."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import cumulative_trapezoid

import jumplab as jl
from jumplab.errors import InputError
from jumplab.models.full import TurningBody
from jumplab.models.srmp import SrmpState
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.joint_qp.rollout import SpatialMapper
from jumplab.stages.planner import STEPS_S, Planner
from jumplab.stages.srmp.settings import SrmpSettings
from jumplab.stages.srmp.spatial import Pendulum, SpatialSrmpPlanner
from jumplab.task import JumpTask

MASS, G = 42.0, 9.8
SIDE = JumpTask(0.1, 0.3, side_m=0.2)
TURN = JumpTask(0.0, 0.3, yaw_rad=np.pi / 4)
BOTH = JumpTask(0.2, 0.4, side_m=-0.2, yaw_rad=np.pi / 2)
NAMES = ("com", "L", "L_rate", "force", "moment", "cop", "spin_torque", "length", "length_rate")


def _function():
    q, v, a = (ca.SX.sym(n, 8) for n in "qva")
    s = Pendulum(MASS, q, v, a, G)
    return ca.Function("pendulum", [q, v, a], [getattr(s, n) for n in NAMES])


FUNCTION = _function()


def seen(q, v, a):
    return {n: x.full().squeeze() for n, x in zip(NAMES, FUNCTION(q, v, a), strict=True)}


def states(count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        place, angles, inertia = rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.5, 0.5, 3), rng.uniform([2, 0.5], [6, 2])
        q = np.concatenate([place, [rng.uniform(0.4, 0.8)], angles, inertia])
        yield q, rng.normal(scale=2, size=8), rng.normal(scale=3, size=8)


@cache
def planner() -> Planner:
    return Planner(jl.Robot.load())


@cache
def stage1(task: JumpTask):
    return planner().stage("spatial srmp").plan(task)


@cache
def stage2(task: JumpTask, method: str = "direct"):
    return map_to_joints(stage1(task), jl.Robot.load(), STEPS_S, method)


def mirrored(task: JumpTask) -> JumpTask:
    return replace(task, side_m=-task.side_m, yaw_rad=-task.yaw_rad)


# the pendulum -----------------------------------------------------------------------------------------------------
def test_force_at_the_cop_and_spin_are_the_whole_wrench():
    for state in states(20):
        x = seen(*state)
        about = np.cross([*x["cop"], 0.0], x["force"])
        about[2] += x["spin_torque"]
        np.testing.assert_allclose(about, x["moment"], rtol=1e-9, atol=1e-9)


def test_momentum_balances_about_the_standing_soles():
    """d/dt (L + c x m c') is the moment of ground and weight, by finite differences of the motion."""
    for q, v, a in states(20, seed=1):

        def total(t, q=q, v=v, a=a):
            at, speed = q + v * t + a * t * t / 2, v + a * t
            return seen(at, speed, a)["L"] + np.cross(at[:3], MASS * speed[:3])

        rate = (total(1e-5) - total(-1e-5)) / 2e-5
        weight = np.cross(q[:3], [0.0, 0.0, -MASS * G])
        np.testing.assert_allclose(rate, seen(q, v, a)["moment"] + weight, rtol=1e-6, atol=1e-5)


def test_in_the_plane_it_is_the_pendulum_of_the_paper():
    rng = np.random.default_rng(2)
    for _ in range(10):
        q, v, a = np.array([0.2, 0.6, 0.1, 0.3]) + rng.normal(scale=0.05, size=4), *rng.normal(size=(2, 4))
        s = SrmpState(MASS, *(ca.DM(x) for x in (q, v, a)), G)
        flat = [np.array(ca.DM(x)).ravel() for x in (s.com, s.com_velocity, s.com_acceleration)]
        rho = [float(x) for x in (s.inertia, s.inertia_rate, s.inertia_accel)]
        wide = [
            np.array([c[0], 0, c[1], 0, turn[0] + turn[2], 0, r, 1.0])
            for c, turn, r in zip(flat, (q, v, a), rho, strict=True)
        ]
        wide[1][7] = wide[2][7] = 0.0
        x = seen(*wide)
        assert x["L"][1] == pytest.approx(float(s.angular_momentum), rel=1e-12)
        assert x["L_rate"][1] == pytest.approx(float(s.angular_momentum_rate), rel=1e-12)
        assert x["moment"][1] == pytest.approx(float(s.pivot_torque), rel=1e-10)
        assert x["force"][[0, 2]] == pytest.approx(np.array(ca.DM(s.ground_force)).ravel(), rel=1e-12)
        assert (x["length"], x["length_rate"]) == pytest.approx((q[1], v[1]), rel=1e-10)


# stage 1 ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("task", [SIDE, TURN, BOTH], ids=["side", "turn", "both"])
def test_stage1_reaches_the_goal_within_its_limits(task):
    plan = stage1(task)
    up, air, body, s = plan.launch, plan.flight, plan.body, SrmpSettings()
    goal = [task.distance_m, task.side_m, 0.0]
    np.testing.assert_allclose(air.com[-1] + air.foot_com[-1], goal, atol=1e-3)
    assert air.yaw[-1] == pytest.approx(task.yaw_rad, abs=1e-3)
    assert up.com_velocity[-1, 2] == pytest.approx(task.takeoff_speed, abs=1e-3)
    assert np.abs(up.force[-1]).max() < 0.5 and np.abs(up.moment[-1]).max() < 0.1  # nothing holds it any more
    pushed = up.force[:, 2] > 50
    used = np.abs(up.force[pushed, :2]).sum(1) / up.force[pushed, 2]
    assert used.max() < 0.42 + 0.01
    heel, toe = body.reach.cop[0] + s.cop_margin_m, body.reach.cop[1]
    beyond = np.maximum(-up.moment[:, 1] - toe * up.force[:, 2], heel * up.force[:, 2] + up.moment[:, 1])
    assert beyond.max() < s.toe_slack_n_m + 0.5  # moment about the sole's end that would tip it [N m]
    assert np.abs(up.cop[pushed, 1]).max() < 0.7 * body.yaw.half_stance_m + 2e-3
    phi = np.linalg.norm(up.com, axis=1)
    low, high = (np.polyval(x, phi) for x in (body.yaw.low_fit, body.yaw.high_fit))
    assert np.all(up.rho[:, 1] > low - 1e-2) and np.all(up.rho[:, 1] < high + 1e-2)


def test_stage1_keeps_all_three_momenta_and_turns_by_them():
    plan = stage1(BOTH)
    up, air = plan.launch, plan.flight
    assert np.ptp(air.L, axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    np.testing.assert_allclose(air.L[0], up.L[-1], atol=1e-3)
    turned = np.trapezoid(air.L[:, 2] / air.rho[:, 1], air.t)
    assert air.yaw[-1] - air.yaw[0] == pytest.approx(turned, abs=2e-3)
    for part in (up, air):  # columns are integrals of each other
        for name, rate in (("com", "com_velocity"), ("com_velocity", "com_acceleration"), ("rho", "rho_rate")):
            x, total = getattr(part, name), cumulative_trapezoid(getattr(part, rate), part.t, axis=0, initial=0.0)
            np.testing.assert_allclose(x - x[0], total, atol=5e-3)
    slope = np.gradient(air.foot_com, air.t, axis=0, edge_order=2)
    np.testing.assert_allclose(slope[1:-1], air.foot_com_rate[1:-1], atol=5e-3)


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_mirrored_target_has_the_mirrored_pendulum(task):
    one, other = stage1(task), stage1(mirrored(task))
    polar, axial = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
    assert other.launch_s == pytest.approx(one.launch_s, abs=1e-4)
    for part in ("launch", "flight"):
        a, b = getattr(one, part), getattr(other, part)
        t = np.linspace(0, 1, 50)
        for name, sign in (("com", polar), ("L", axial), ("rho", np.ones(2))):
            x, y = (np.stack([np.interp(t, p.t / p.t[-1], c) for c in getattr(p, name).T], -1) for p in (a, b))
            np.testing.assert_allclose(y, sign * x, atol=5e-3)


def test_own_terms_reach_stage1(bhr):
    low = jl.Term("little spin", "ours", "kg m^2/s", "node", lambda p: p.L[2], weight=20.0)
    mine = Planner(bhr, terms={"spatial srmp/flight": [low]}).stage("spatial srmp").plan(TURN)
    assert abs(mine.flight.L[0, 2]) < abs(stage1(TURN).flight.L[0, 2]) - 0.02
    assert mine.flight.rho[:, 1].mean() < stage1(TURN).flight.rho[:, 1].mean()


def test_settings_of_the_plane_reach_stage1(bhr):
    mine = Planner(bhr, settings={"w_time": 3.0}).stage("spatial srmp")
    assert mine.settings.w_time == 3.0 and mine.settings.friction == 0.42


def test_flips_are_refused():
    with pytest.raises(InputError) as e:
        SpatialSrmpPlanner.plan(planner().stage("spatial srmp"), replace(TURN, rotation_rad=2 * np.pi))
    said = (
        "rotation = 360 deg: stage 1 in three dimensions has no flips; ask for no rotation, or for the method 'direct'"
    )
    assert str(e.value) == said


# stage 2 ----------------------------------------------------------------------------------------------------------
def test_both_inertias_and_their_slopes(bhr):
    body, rng = TurningBody(bhr), np.random.default_rng(3)
    q = pin.neutral(bhr.model)
    q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.2, 0.3, 2.0)).coeffs()
    q[7:] = rng.uniform(-0.5, 0.5, len(q) - 7)
    v, step = rng.normal(size=body.nv), 1e-6
    x, data = body.terms(q, v), bhr.model.createData()
    pin.ccrba(bhr.model, data, q, v)
    left = pin.Quaternion(q[3:7]).toRotationMatrix()[:, 1] * [1, 1, 0]
    left /= np.linalg.norm(left)
    assert x.rho == pytest.approx([left @ data.Ig.inertia @ left, data.Ig.inertia[2, 2]], rel=1e-12)

    def at(way, length):
        return body.motion(pin.integrate(bhr.model, q, length * way), v).rho

    slope = np.array([(at(way, step) - at(way, -step)) / (2 * step) for way in np.eye(body.nv)]).T
    np.testing.assert_allclose(x.J_rho, slope, atol=1e-7)
    second = (at(v, 1e-3) - 2 * x.rho + at(v, -1e-3)) / 1e-6
    np.testing.assert_allclose(x.drift_rho, second, rtol=1e-4, atol=1e-4)
    assert body.motion(q, v).rho_rate == pytest.approx(x.J_rho @ v, rel=1e-12)


def test_a_turned_robot_has_the_same_inertias(bhr):
    body, q = TurningBody(bhr), jl.robot.stance.stance_configuration(bhr)
    q[7:] += np.random.default_rng(4).uniform(-0.3, 0.3, len(q) - 7)
    turned = q.copy()
    turned[3:7] = (pin.Quaternion(pin.rpy.rpyToMatrix(0, 0, 1.3)) * pin.Quaternion(q[3:7])).coeffs()
    still = np.zeros(body.nv)
    assert body.motion(turned, still).rho == pytest.approx(body.motion(q, still).rho, rel=1e-12)


def test_no_row_mirrors_left_and_right(bhr):
    mapper = SpatialMapper(stage1(TURN), bhr, STEPS_S)
    flight = mapper.flight_from(stage2(TURN).state(stage2(TURN).rows("flight").start))
    for qp in (mapper.launch, flight):
        assert len(qp.S) == 0 and qp.layout.labels["E"][-1].split()[0] != "symmetry"
        assert [x for x in qp.layout.labels["A"] if x.startswith("inertia")] == [
            "inertia rho",
            "inertia rho about the vertical",
        ]


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_stage2_follows_stage1(task):
    plan = stage2(task)
    found = plan.tracking
    assert found["takeoff_velocity"] < 0.1 and found["takeoff_momentum"] < 0.1, found
    assert found["flight_foot_rms"] < 0.05 and found["launch_com"] < 0.05, found
    assert plan.statistics.worst_residual < 1e-6


def test_stage2_keeps_all_three_momenta(bhr):
    plan = map_to_joints(stage1(TURN), bhr, 0.01, "direct")
    L = plan.actual["L"][plan.rows("flight")]
    assert np.abs(L - L[0]).max() < 0.05


def test_mirrored_target_has_the_mirrored_motion(bhr):
    one, other = stage2(SIDE), stage2(mirrored(SIDE))
    t = np.linspace(0.0, 0.9, 30)
    for name, sign in (("com", [1, -1, 1]), ("L", [-1, 1, -1]), ("rho", [1, 1])):
        x, y = (np.stack([np.interp(t, p.t / p.t[-1], c) for c in p.actual[name].T], -1) for p in (one, other))
        np.testing.assert_allclose(y, sign * x, atol=0.03)


def test_own_terms_reach_stage2(bhr):
    def arms_in(p):
        return p.inertia_acceleration[1] + 400.0 * (p.inertia[1] - 0.6) + 40.0 * p.inertia_rate[1]

    low = jl.Term("arms in", "ours", "kg m^2/s^2", "node", arms_in, weight=3.0)
    mine = map_to_joints(stage1(TURN), bhr, STEPS_S, "direct", terms={"flight": [low]})
    assert mine.actual["rho"][-1, 1] < stage2(TURN).actual["rho"][-1, 1] - 0.05


def test_feet_turn_to_the_asked_heading(bhr):
    body, plan = TurningBody(bhr), stage2(TURN)
    for turn in body.motion(plan.q[-1], plan.v[-1]).foot_rotation:
        assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(TURN.yaw_rad, abs=0.1)


def test_both_solvers_find_the_same_motion():
    one, other = stage2(TURN), stage2(TURN, "cvxpy")
    assert np.abs(one.q - other.q).max() < 1e-4


# chained ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_three_steps_end_in_a_clean_plan():
    plan = planner().plan(TURN, "three-step")
    assert plan.skipped is None
    assert [row.stage.split(",")[0] for row in plan.statistics] == ["1 SRMP", "2 joint map", "3 spatial"]
    report = jl.audit(plan)
    assert report.passed, report.table()
    found = plan.summary["tracking"]
    assert set(found) == {"launch", "flight"}
    assert set(found["flight"]) == {"rho", "rho_rate", "yaw_rho", "yaw_rho_rate", "velocity", "L"}
    assert found["flight"]["yaw_rho"]["relative_rms"] < 0.5
    assert set(plan.weights) == {"SRMP", "joint map", "whole body"} and len(plan.terms()) > 100
    e = plan.tape.extra
    L = e["srmp_flight_L"][0]
    assert L[2] == pytest.approx(stage1(TURN).flight.L[0, 2], rel=1e-6) and e["rho"].shape == (
        len(e["inertia_rows"]),
        2,
    )
    guess = plan.joints.t, plan.joints.q[:, 7:], plan.joints.v[:, 6:]
    figures = [jl.plots.inertia_and_momentum(plan.tape), jl.plots.margins(plan.tape, plan.robot)]
    figures.append(jl.plots.joint_trajectories(plan.tape, plan.robot, guess=guess))
    assert [len(fig.axes) for fig in figures] == [6, 9, 14]


@pytest.mark.slow
def test_where_stage_2_finds_no_way_the_plan_says_so(monkeypatch):
    def lost(*given, **how):
        raise jl.errors.SolverError("stage 2: no way", stage="joint_map", status="none")

    monkeypatch.setattr("jumplab.stages.planner.map_to_joints", lost)
    plan = planner().plan(TURN, "three-step")
    said = "stage 2: no way; stage 3 began from a jump ahead with ramps of side and yaw instead"
    assert plan.skipped == said and plan.summary["skipped"] == said
    assert plan.srmp is None and plan.statistics[-1].stage == "spatial" and jl.audit(plan).passed


def test_terms_of_the_plane_have_no_place(bhr):
    with pytest.raises(InputError) as e:
        Planner(bhr, weights={"srmp/turn": 3.0}).plan(TURN, "three-step", weights={"torque": 1.0})
    assert str(e.value) == (
        "three steps to the side or with a turn have no place for 'srmp' and 'whole body': their stages are "
        "'spatial srmp', 'joint qp' and 'spatial'; leave that out, or choose the method 'direct'"
    )
