"""Flips: the start turns, the plan turns, its physics is looked at by other code, and the robot lands it."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import planner
from paper.drawings import trunk_angle
from paper.planar import planar_quantities

from jumplab import auditing as passport
from jumplab import plan as planned
from jumplab.control.controller import Controller, level
from jumplab.control.flight import LATER_S, SOONER_S, Flight, is_flip
from jumplab.control.kinematics import Gauge, rotation, turned
from jumplab.control.playback import Playback
from jumplab.errors import InputError, SolverError
from jumplab.robot import Robot
from jumplab.sim import STEP_S, Perturbation, Ranges, simulate_jump
from jumplab.stages.joint_qp import map_to_joints
from jumplab.stages.reconstruction import to_link_angles
from jumplab.stages.whole_body import Limits, Mesh, Weights, WholeBodyPlanner, motions
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import even
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.settings import LATE_SHARE, RESERVE_SHARE
from jumplab.studies import robust
from jumplab.studies.trials import TrialKey
from jumplab.task import JumpTask

TURN = 2 * np.pi
STANCE_PITCH_RAD = 0.05  # of the trunk


@lru_cache
def backflip():
    return planner().plan(JumpTask(0.0, 0.5, rotation_rad=-TURN), "direct")


@pytest.mark.parametrize("turns", (-2, -1, 1, 2))
def test_start_turns_as_asked_and_goes_where_it_should(turns):
    """The trunk ends after whole turns, near upright; the sole nearly flat and near the target; nothing jumps.

    Legs are those of the stance, turned over with the trunk: they end as far off as it leans.
    """
    flips = planner().program(JumpTask(0.2, 0.5, rotation_rad=TURN))
    task = JumpTask(0.2, 0.5, rotation_rad=turns * TURN)
    schedule = Schedule(flips.body, flips.contacts, flips.limits, flips.weights, free=flips.free)
    motion = motions.along(schedule, task)
    guess = motions.guess(schedule, task, motion)
    flown = motion.charts[-1]
    lean = flown[-1, 5] - turns * TURN
    assert 0.0 < lean < 0.3
    assert np.abs(np.diff(flown, axis=0)).max() < 1.0  # no jump on the way
    assert {n: len(g.q) - 1 for n, g in guess.items()} == Mesh().of_flip().intervals()
    np.testing.assert_allclose(guess["flat"].q[0], flips.free.taken(flips.body.stance))
    robot = flips.robot
    model = robot.model
    data = model.createData()
    frame = model.getFrameId(robot.foot.frames[0])
    q = flips.body.model.to_pinocchio(flown[-1:], 0 * flown[-1:], 0 * flown[-1:])[0][0]
    pin.framesForwardKinematics(model, data, q)
    foot = data.oMf[frame]
    assert np.arctan2(-foot.rotation[2, 0], foot.rotation[0, 0]) == pytest.approx(lean - STANCE_PITCH_RAD, abs=1e-6)
    np.testing.assert_allclose(foot.act(robot.foot.tip) - flips.body.places[0], [0.2, 0.0, 0.0], atol=0.15)


def test_a_jump_keeps_its_own_limits():
    """Settings of flips are a copy: jumps without rotation have another planner and the settings of before."""
    assert Limits().capture_moment is None and Limits().least_push == 0
    assert Limits().touchdown_ankle_stroke is None
    assert Limits().touchdown_trunk_rate == 1.0 and Limits().of_flip().touchdown_trunk_rate == 5.0
    assert Limits().of_flip().torque_share == Limits().torque_share == 0.85  # the stated margin
    finer = Mesh().of_flip().intervals()
    assert all(finer[name] >= 2 * n for name, n in Mesh().intervals().items())
    lighter = {k for k, w in vars(Weights().of_flip()).items() if w < vars(Weights())[k]}
    assert lighter == {f"track_{x}" for x in ("velocity", "momentum", "inertia", "inertia_rate", "flight_inertia_rate")}
    for kind in ("direct", "whole body"):
        usual, flips = (planner().stage(kind, flip=flip) for flip in (False, True))
        assert (usual.limits, usual.weights, usual.mesh) == (Limits(), Weights(), Mesh())
        assert (flips.limits, flips.weights) == (Limits().of_flip(), Weights().of_flip())
        assert flips.mesh == Mesh().of_flip()


def test_rotation_is_whole_turns():
    with pytest.raises(InputError, match="lands on its feet only after a multiple of 360 deg; nearest is -360 deg"):
        JumpTask(0.0, 0.5, rotation_rad=np.radians(-300.0))


@pytest.mark.slow
def test_backflip_passes_the_audit():
    plan = backflip()
    audit = passport.audit(plan.tape, plan.robot, plan.task)
    assert [c.name for c in audit.checks if not c.passed] == []
    turned = np.ptp(trunk_angle(plan.tape.q)[[0, -1]])
    assert abs(turned - TURN) < 0.35  # the trunk may lean by 0.3 rad at touchdown


@pytest.mark.slow
def test_launch_keeps_its_cop_off_the_edges():
    """From the motion at the solution's own nodes: 3 cm while nothing else holds the robot."""
    plan = backflip()
    limits = Limits().of_flip()
    flat = plan.whole_body.phases["flat"]
    robot = plan.robot
    n = len(flat.t) - 1
    model = plan.whole_body.schedule.body.model
    links = to_link_angles(robot, *model.to_pinocchio(flat.q, flat.v, flat.a))
    wrench = planar_quantities(robot, *links, np.zeros((n + 1, 2)), 9.8)["ground_wrench"]
    cop = -wrench[:, 2] / wrench[:, 1]  # from the toe
    reserve = limits.cop_reserve_share * (robot.foot.toe - robot.foot.heel)
    held = slice(int(RESERVE_SHARE[0] * n) + 1, int((1 - RESERVE_SHARE[1]) * n))
    assert cop[held].max() < -reserve + 1e-4
    assert cop[held].min() > robot.sagittal.heel[0] + limits.cop_margin_m + reserve - 1e-4
    assert wrench[:-1, 1].min() > limits.least_push * robot.total_mass * 9.8 - 0.1


@pytest.mark.slow
def test_tuck_forecasts_the_planned_turn_and_mends_a_wrong_one():
    """With the plan's own L the forecast, int (L - h) / I dt, ends where the tape does."""
    plan = backflip()
    tape, tuck = plan.tape, Flight(plan.robot, plan.tape, level)
    assert is_flip(tape)
    L = float(np.ravel(tape.extra["planar_L"])[-1])
    row = tape.takeoff_index + 1
    turn = tuck.trunk_turn(0.0, float(tape.t[row]), float(tape.t[-1] - tape.t[row]), L)
    assert abs(turn - (trunk_angle(tape.q)[-1] - trunk_angle(tape.q)[row])) < 0.02
    at = row + 280
    now, left = float(tape.t[at]), float(tape.t[-1] - tape.t[at])
    longer, shorter = (abs(tuck.trunk_turn(size, now, left, L)) for size in (-0.03, 0.03))
    assert longer > abs(tuck.trunk_turn(0.0, now, left, L)) + 0.05 > shorter + 0.1
    shift, *_ = tuck.shift(round(now * 1000), Gauge(plan.robot).motion(tape.q[at], tape.v[at]), left)
    assert abs(shift) <= 1e-3  # nothing to mend


def test_torques_of_an_unshifted_flight_are_those_of_the_tape():
    """Inverse dynamics of the free body are what the planner's own tape holds, friction of the motors included."""
    plan = backflip()
    tape, tuck = plan.tape, Flight(plan.robot, plan.tape, level)
    player = Playback(tape, plan.robot)
    for row in np.arange(tape.takeoff_index + 20, len(tape.t) - 20, 60):
        told = player.command(round(float(tape.t[row]) / STEP_S), tape.q[row], tape.v[row])
        assert tuck.torque(told, tape.q[row], tape.v[row]) == pytest.approx(told.tau, abs=0.02 * np.ptp(tape.tau))


@pytest.mark.slow
def test_joints_follow_a_tuck_that_opens_sooner(monkeypatch):
    """By 60 ms: within 16 mrad, and 47 mrad where drives are sent the torques of the tape as planned."""
    plan = backflip()
    asked = []
    monkeypatch.setattr(Flight, "_best", lambda *_: 0.06)
    command = Playback.command

    def noted(self, *given):
        asked.append(command(self, *given))
        return asked[-1]

    monkeypatch.setattr(Playback, "command", noted)
    result = simulate_jump(plan.tape, plan.robot, reaim=True)
    flown = slice(plan.tape.takeoff_index + 50, len(asked) - 130)  # until legs are aimed as well
    lag = result.q[flown, 7:] - np.array([x.q for x in asked])[flown]
    assert np.abs(lag).max() < 0.025


def test_feet_that_point_backwards_upside_down_have_not_turned():
    """A robot that flies rolled by 3 degrees: its feet's headings, unwrapped sample by sample, go once round."""
    tape, robot = backflip().tape, backflip().robot
    rolled = pin.rpy.rpyToMatrix(0.05, 0.0, 0.0)
    q = np.array([turned(row, rolled) for row in tape.q])
    headings = np.unwrap([Gauge(robot).heading(row) for row in q[tape.flights[-1]]])
    assert abs(headings[-1] - headings[0]) == pytest.approx(TURN, abs=0.05)
    assert Controller(replace(tape, q=q), robot).ahead.to_json()["reason"] is None


@pytest.mark.parametrize("flight_s", [0.35, 0.5, 0.65, 0.9])
def test_a_shifted_tape_never_runs_backwards(flight_s):
    """However short the flight, at the largest shift either way, once it has grown; one that waits arrives in time."""
    plan = backflip()
    tape, last = plan.tape, plan.tape.t[-1] - plan.tape.takeoff_time
    t = tape.takeoff_time + (tape.t - tape.takeoff_time) * flight_s / last
    tuck = Flight(plan.robot, replace(tape, t=np.where(tape.t < tape.takeoff_time, tape.t, t)), level)
    _, pace, _ = tuck.pieces(tuck.sooner_s, tape.takeoff_time, flight_s, 32)
    assert pace.min() > 0.03
    t = np.linspace(tape.takeoff_time, tuck.end_s, 400)
    there = tuck.place(-tuck.later_s, t, tape.takeoff_time, flight_s)
    waits = (there == tuck.tight_s).sum() * (t[1] - t[0])
    assert (
        np.diff(there).min() >= 0
        and there[-1] == pytest.approx(tuck.end_s)
        and waits == pytest.approx(tuck.later_s, abs=4e-3)
    )
    if flight_s > 0.64:
        assert tuck.sooner_s == SOONER_S


@pytest.mark.slow
def test_tuck_forecasts_the_attitude_about_all_axes():
    """A body as planned ends as planned; one that is turned about the vertical, L with it, ends turned as much."""
    plan = backflip()
    tape, tuck, yaw, gauge = plan.tape, Flight(plan.robot, plan.tape, level), 0.3, Gauge(plan.robot)
    for at in (tape.takeoff_index + 280, tape.takeoff_index + 500):
        now, left = float(tape.t[at]), float(tape.t[-1] - tape.t[at])
        tuck.shift(step := round(now / STEP_S), gauge.motion(tape.q[at], tape.v[at]), left)
        for turn in (np.eye(3), pin.rpy.rpyToMatrix(0.0, 0.0, yaw)):
            there = tuck.turn_ahead(step, gauge.motion(turned(tape.q[at], turn), tape.v[at]), left)
            assert np.abs(pin.log3(there @ turn.T)).max() < 0.02
    end = gauge.motion(turned(tape.q[-1], turn), tape.v[-1])
    assert tuck.turn_ahead(step, end, 0.0) == pytest.approx(turn, abs=1e-9)


@pytest.mark.slow
def test_a_rolled_and_yawed_flip_meets_the_ground_with_flat_soles():
    plan = backflip()
    drawn = Perturbation.draw(plan.robot, TrialKey(0, 9, "", "").robot_seed)
    result = simulate_jump(plan.tape, plan.robot, perturbation=drawn, reaim=True)
    down = int(np.searchsorted(result.t, result.metrics.touchdown_s))
    gauge, q = Gauge(plan.robot), result.q[down]
    off = pin.log3(rotation(q[3:7]) @ rotation(plan.tape.q[-1, 3:7]).T)
    assert np.abs(off[[0, 2]]).max() > 0.2
    tilts = [np.arcsin(abs(place.rotation[2, 1])) for place in gauge.places(q)]
    assert max(tilts) < abs(off[0]) and result.landed, result.reason


@pytest.mark.slow
def test_a_robust_backflip_lands_a_robot_that_turns_too_slowly():
    """It opens its tuck slowly, so that it can open late; the launch of this robot gives 3 % less momentum, by servos
    that know the base."""
    task = JumpTask(0.0, 0.5, rotation_rad=-TURN)
    plan = planned(task, robust=Ranges())
    assert passport.audit(plan.tape, plan.robot, plan.task).passed
    opening = plan.tape.t > plan.tape.t[-1] - 0.9 * LATE_SHARE * (plan.tape.t[-1] - plan.tape.takeoff_time)
    share = np.abs(plan.tape.v[opening, 6:]) / plan.robot.limits.speed
    assert share.max() < robust.OPENING_SHARE + 0.05
    used = np.abs(plan.tape.tau[opening]) / plan.robot.limits.effort
    assert used.max() < robust.OPENING_TORQUE_SHARE + 0.05
    assert Flight(plan.robot, plan.tape, level).later_s > 3 * LATER_S
    drawn = Perturbation.draw(plan.robot, TrialKey(1, 5, "", "").robot_seed)
    result = simulate_jump(plan.tape, plan.robot, mode="whole-body", perturbation=drawn, reaim=True)
    assert result.landed and result.checks_passed, result.reason


@pytest.mark.slow
def test_a_perturbed_backflip_arrives_as_planned_and_lands():
    """Every link and motor off, commands 3 ms late of which 2 are known: it falls if its tuck opens by the clock."""
    plan = backflip()
    seed = TrialKey(0, 2, "", "").robot_seed
    drawn = Perturbation.draw(plan.robot, seed)
    result = simulate_jump(plan.tape, plan.robot, perturbation=drawn, reaim=True)
    assert result.landed and result.checks_passed, result.reason
    assert abs(result.metrics.touchdown_trunk_pitch_rad - trunk_angle(plan.tape.q)[-1]) < 0.15


@pytest.mark.slow
def test_backflip_is_captured_by_its_momentum():
    """L about the middle of the soles, from the tape: L + m (z v_x - dx v_z)."""
    plan = backflip()
    tape, limits = plan.tape, Limits().of_flip()
    com, speed = tape.extra["planar_com"][-1], tape.extra["planar_com_velocity"][-1]
    half = (plan.robot.foot.toe - plan.robot.foot.heel) / 2
    dx, z = com - tape.extra["planar_toe"][-1] + [half, 0.0]
    sagittal, L = plan.robot.sagittal, float(np.ravel(tape.extra["planar_L"])[-1])
    assert L < -15  # backward
    leg, mass = plan.whole_body.schedule.body.leg_m, sagittal.total_mass
    share = (L + mass * (z * speed[0] - dx * speed[1])) / (mass * leg * np.sqrt(9.8 * leg))
    low, high = limits.capture_in_plane[:2]
    assert low - 2e-3 <= share <= high + 2e-3
    stroke = float(np.ravel(tape.extra["planar_joints"][-1])[2]) - sagittal.lower[2]
    assert stroke >= Limits().of_flip().touchdown_ankle_stroke - 1e-3
    assert abs(plan.whole_body.phases["flight"].v[-1, 5]) <= 5.0 + 1e-4  # as closely as the solver meets its rows
    # on the tape L is kept between the nodes too, and legs that arrive make up for what the plan misses of it
    assert abs(plan.tape.v[-1, 4]) <= 5.0 + 5e-3


@pytest.mark.slow
def test_backflip_lands_by_planned_torques():
    plan = backflip()
    result = simulate_jump(plan.tape, plan.robot, mode="pd")
    assert result.landed, result.reason
    down = int(np.searchsorted(result.t, result.metrics.touchdown_s))
    assert abs(trunk_angle(result.q)[down] - trunk_angle(plan.tape.q)[-1]) <= 0.15
    assert result.metrics.touchdown_trunk_pitch_rad == pytest.approx(trunk_angle(result.q)[down])  # turns counted
    assert abs(result.metrics.com_rise_m - 0.5) < 0.03


@pytest.mark.slow
def test_flips_by_three_steps_have_no_stage_2():
    task = JumpTask(0.0, 0.5, rotation_rad=-TURN)
    plan = planner().plan(task, "three-step")
    assert plan.srmp is not None and plan.joints is None
    assert [row.stage[0] for row in plan.statistics[:2]] == ["1", "3"]
    assert passport.audit(plan.tape, plan.robot, plan.task).passed
    assert "three-step without stage 2" in plan.line()
    L = float(np.ravel(plan.tape.extra["planar_L"])[-1])
    assert abs(L / plan.srmp.launch.L[-1] - 1) <= Limits().of_flip().momentum_share + 0.01
    with pytest.raises(InputError, match="a flip is planned without stage 2; leave out all changes of 'joint qp'"):
        planner().plan(task, "three-step", weights={"joint qp/flight/posture": 2.0})
    with pytest.raises(InputError, match=r"stage 2 cannot follow a flip \(rotation_rad = -?6\.28, must be 0\);"):
        map_to_joints(plan.srmp, plan.robot)


def flips_of(robot, **how):
    """The direct planner of a robot's flips."""
    body = Body(robot)
    settings = Mesh().of_flip(), Limits().of_flip(), Weights().of_flip()
    return WholeBodyPlanner(robot, *settings, body=body, free=even(body), **how)


@pytest.mark.slow
def test_a_flip_that_motors_forbid_says_what_is_missing():
    """With a third of its efforts it does not come round: the rows that are missed are named, and by how much."""
    weak = flips_of(Robot.load().with_limits(effort=0.3), options={"max_iter": 50})
    with pytest.raises(SolverError, match=r"compromise still violates .+ by .+; these constraints conflict") as caught:
        weak.plan(JumpTask(0.0, 0.5, rotation_rad=-TURN))
    assert caught.value.violations


@pytest.mark.slow
def test_a_load_fixed_to_the_base_is_no_force_on_a_body_that_turns_over():
    """The CoM of the base's link, whose velocity PyBullet keeps, is not that of link and load."""
    plan = backflip()
    drawn = Perturbation.draw(plan.robot, 1, Ranges.none(payload_kg=(2.0, 2.0)))
    result = simulate_jump(plan.tape, plan.robot, engine="bullet", perturbation=drawn)
    found = {x.name: x.value for x in result.checks}
    assert found["unexplained force on the body"] < 0.05
