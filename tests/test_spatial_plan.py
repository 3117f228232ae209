"""Jumps in three dimensions: planned, on tape exact, audited, played back, re-planned, refused."""

import json
from dataclasses import replace
from functools import cache, partial
from itertools import chain, repeat
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import planner, refused, slopes
from paper.basin import WrongApex
from test_transcription import data_vector, sparse

import jumplab as jl
from jumplab.auditing import audit
from jumplab.auditing.replay import replay
from jumplab.auditing.report import LIMITS, METHOD
from jumplab.cli.main import main
from jumplab.control.kinematics import Gauge, headed, pitch_of, rotation
from jumplab.control.playback import Playback
from jumplab.control.servo import WholeBodyServo
from jumplab.errors import InfeasibleError, SolverError
from jumplab.models.spatial import SpatialState
from jumplab.ocp.nlp import EXPLAINED
from jumplab.ocp.posing import pack
from jumplab.ocp.problem import Point
from jumplab.ocp.solution import PhaseSolution
from jumplab.robot.stance import configuration, stance_angles
from jumplab.sim import STEP_S, simulate_jump
from jumplab.sim.scene import Scene
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Contacts, Limits, Mesh, Place, Weights, WholeBodyPlanner, between
from jumplab.stages.whole_body import plan as ended
from jumplab.stages.whole_body import planner as planning
from jumplab.stages.whole_body.apart import MORE_M, NODES, face_gaps, merged, placed, too_close, used_apart
from jumplab.stages.whole_body.between import used_between
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import BASE, even
from jumplab.stages.whole_body.ground import Surface, surface_of_jump
from jumplab.stages.whole_body.instant import Instant
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.program import FINER, Program
from jumplab.stages.whole_body.shapes import ROUNDED_M, Apart, Pair
from jumplab.stages.whole_body.starts import COLD, FROM_NEIGHBOUR, Asked, unpassed
from jumplab.stages.whole_body.tape import AIR, FLAT, TOE, pressed
from jumplab.task import JumpTask

SIDE = JumpTask(0.0, 0.4, side_m=0.3)
TURN = JumpTask(0.2, 0.4, side_m=-0.1, yaw_rad=np.pi / 3)


@cache
def jump(task: JumpTask):
    return planner().plan(task, "direct")


@cache
def walker() -> WholeBodyPlanner:
    """Plans one step with the right foot."""
    robot = jl.Robot.load()
    return WholeBodyPlanner(robot, contacts=Contacts.of("LR L LR", robot, [Place(0.15)]))


@cache
def step():
    """Plan and tape of that step."""
    plan = walker().plan(JumpTask(0.0, 0.2))
    return plan, plan.tape


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_tape_is_exact_physics_between_the_nodes(task):
    plan = jump(task)
    r = replay(plan.tape, plan.robot, task)
    assert np.abs(r.base_residual).max() < 1e-6 * r.weight  # all six rows, at every millisecond
    (flight,) = r.flights
    assert np.abs(r.momentum[flight] - r.momentum[flight][0]).max() < 1e-6  # all three components
    toes = r.toe_corners[r.ground]
    assert np.abs(toes - toes[0]).max() < 1e-6
    assert np.abs(r.tau - plan.tape.tau).max() < 1e-6


def told_twice(tape) -> np.ndarray:
    """Rows at whose instant another row follows."""
    return np.flatnonzero(np.diff(tape.t) < 1e-6)


@pytest.mark.parametrize("name", ["side", "turn", "step"])
def test_tape_is_smooth_up_to_each_take_off_and_landing(name):
    """Accelerations jump there alone, rates and places nowhere; heels rise from rest."""
    tape = step()[1] if name == "step" else jump({"side": SIDE, "turn": TURN}[name]).tape
    codes, twice = tape.extra["contacts"], told_twice(tape)
    feet = np.flatnonzero(np.any((codes[1:] == AIR) != (codes[:-1] == AIR), axis=1))
    lands = np.any(codes[feet + 1] > codes[feet], axis=1)
    flies = ~codes[feet + 1].any(axis=1)
    # a foot that leaves while another one stands needs no instant of its own
    assert twice.tolist() == feet[lands | flies].tolist()
    for x, most in ((tape.q, 1e-4), (tape.v, 1e-3)):  # a foot lands as closely as the solver meets its rows
        assert np.abs(np.diff(x, axis=0)[twice]).max() < most
    jumps = np.abs(np.diff(tape.a, axis=0)).max(axis=1)
    around = np.maximum(np.roll(jumps, 1), np.roll(jumps, -1))
    beside = np.concatenate([twice - 1, twice, twice + 1])
    inside = np.setdiff1d(np.arange(1, len(jumps) - 1), beside)
    assert np.all(jumps[inside] < 2 * around[inside] + 0.5)
    dt = np.diff(tape.t)[:, None]
    moves = np.setdiff1d(np.arange(len(dt)), twice)
    mean = (tape.v[1:, 6:] + tape.v[:-1, 6:]) / 2
    gap = np.diff(tape.q[:, 7:], axis=0)[moves] / dt[moves] - mean[moves]
    assert np.abs(gap).max() < between.RATE_GAP


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_tape_says_how_each_foot_stands(task):
    """Flat, then on its toes, then in the air, both alike; there it carries nothing."""
    tape = jump(task).tape
    codes = tape.extra["contacts"]
    assert np.array_equal(codes[:, 0], codes[:, 1])
    assert np.all(np.diff(codes[:, 0].astype(int)) <= 0)
    assert set(codes[:, 0].tolist()) == {FLAT, TOE, AIR}
    assert np.array_equal(tape.phase == "launch", codes.any(axis=1))
    assert not tape.f[codes == AIR].any()
    rising = np.argmax(codes[:, 0] == TOE)
    assert tape.extra["toe_phase_start"] == pytest.approx(tape.t[rising])


def test_a_step_moves_one_foot_to_its_place(bhr):
    """The other one stays where it is; forces and momentum are those of the motion all the same."""
    plan, tape = step()
    data, model = bhr.model.createData(), bhr.model
    frames = [model.getFrameId(name) for name in bhr.foot.frames]
    soles = []
    for q in tape.q:
        pin.framesForwardKinematics(model, data, q)
        soles.append([[data.oMf[frame].act(x) for x in bhr.foot.corners] for frame in frames])
    soles, codes = np.array(soles), tape.extra["contacts"]
    assert np.abs(soles[:, 0] - soles[0, 0]).max() < 1e-6 and np.all(codes[:, 0] == FLAT)
    lifted = codes[:, 1] == AIR
    assert soles[lifted, 1, :, 2].max() > 0.02 and soles[..., 2].min() > -1e-6
    first, last = np.split(soles[~lifted, 1], [np.argmax(lifted)])
    aside = plan.solution.phases["3 LR"].constants["right_y"] - Body(bhr).places[1, 1]
    assert np.abs(first - first[0]).max() < 1e-6 and np.abs(last - last[0]).max() < 1e-6
    way = np.tile([0.15, aside, 0.0], (4, 1))
    assert last[0] - first[0] == pytest.approx(way, abs=1e-6)
    assert abs(aside) < Place(0.15).free_m[1] + 1e-6
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for row in range(0, len(tape.t), 50):
        need = pin.rnea(model, data, tape.q[row], tape.v[row], tape.a[row])
        pin.computeJointJacobians(model, data, tape.q[row])
        pin.updateFramePlacements(model, data)
        for frame, wrench in zip(frames, tape.f[row], strict=True):
            need -= pin.getFrameJacobian(model, data, frame, axes).T @ wrench
        assert np.abs(need[:6]).max() < 1e-6 and need[6:] == pytest.approx(tape.tau[row], abs=1e-6)
    assert (plan.flight_s, plan.launch_s) == (0.0, pytest.approx(tape.t[-1], abs=1e-3))
    assert np.abs(tape.v[-1]).max() < 1e-3 and not tape.f[lifted, 1].any()


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_audit_is_clean_and_the_goal_is_reached(task):
    plan = jump(task)
    report = audit(plan.tape, plan.robot, task)
    assert report.passed, report.table()
    assert "left/right posture" not in [c.name for c in report.checks]
    assert report["place"].value < 2 and report["heading"].value < 2
    found = plan.planned_distance_m, plan.planned_side_m, plan.planned_yaw_rad, plan.planned_rise_m
    assert found == pytest.approx((task.distance_m, task.side_m, task.yaw_rad, task.height_m), abs=2e-3)


@pytest.mark.parametrize("task", [SIDE, TURN], ids=["side", "turn"])
def test_soles_come_down_steeply_enough_to_stick(task):
    plan = jump(task)
    data = plan.robot.model.createData()
    pin.forwardKinematics(plan.robot.model, data, plan.tape.q[-1], plan.tape.v[-1])
    used = []
    for frame in map(plan.robot.model.getFrameId, plan.robot.foot.frames):
        arm = pin.updateFramePlacement(plan.robot.model, data, frame).rotation @ plan.robot.foot.center
        twist = pin.getFrameVelocity(plan.robot.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        speed = twist.linear + np.cross(twist.angular, arm)
        used.append(np.abs(speed[:2]).max() / -speed[2])
    assert 0.2 < max(used) < Limits().touchdown_slope + 1e-3  # and it matters to these targets


def test_audit_sees_another_goal():
    plan = jump(TURN)
    other = replace(TURN, side_m=-0.12, yaw_rad=TURN.yaw_rad + 0.01)
    failed = {c.name: c.value for c in audit(plan.tape, plan.robot, other).failed}
    assert failed == {"place": pytest.approx(20, abs=2), "heading": pytest.approx(10, abs=1)}


@pytest.mark.slow
@pytest.mark.parametrize("task, mode", [(SIDE, "position"), (TURN, "pd")], ids=["side", "turn"])
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
def test_playback_lands_in_its_place_and_heading(task, engine, mode):
    result = jl.simulate(jump(task), mode=mode, engine=engine)
    m = result.metrics
    assert result.landed and result.checks_passed, result.reason
    assert np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m) < 0.02
    assert abs(m.yaw_rad - task.yaw_rad) < np.radians(3)
    assert abs(m.com_rise_m - task.height_m) < 0.02
    said = result.settings["landing"]
    turned = "stage 1 knows no landing after a turn by 60 degrees"
    assert (said["followed"], said["reason"]) == (("spring", turned) if task.yaw_rad else ("planned", None))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["bullet", "mujoco"])
@pytest.mark.parametrize("task, tipped_rad", [(SIDE, 0.1), (TURN, -0.1)])
def test_lands_on_one_foot_before_the_other(task, tipped_rad, engine):
    """Tipped sideways in flight, one sole meets the ground 2 cm before the other; the robot stands all the same."""
    tipped = WrongApex(1.0, tipped_rad, direction_rad=np.pi / 2)
    result = simulate_jump(jump(task).tape, jl.Robot.load(), engine=engine, disturbance=tipped)
    loaded = (result.foot_wrench[:, :, 2] > 30.0) & (result.phase == "landing")[:, None]
    left, right = (result.t[np.argmax(foot)] for foot in loaded.T)
    assert 0.004 < (right - left) * np.sign(tipped_rad) < 0.03, (left, right)
    assert result.landed and result.checks_passed, result.reason


def test_mirrored_target_has_the_mirrored_plan_of_its_feet():
    left, right = jump(SIDE), jump(replace(SIDE, side_m=-0.3))
    assert right.whole_body.solution.statistics.objective == pytest.approx(
        left.whole_body.solution.statistics.objective, rel=0.02
    )
    assert right.planned_side_m == pytest.approx(-left.planned_side_m, abs=2e-3)


def test_neighbour_is_planned_from_the_plan():
    before = jump(SIDE)
    after = planner().replan(before, replace(SIDE, side_m=0.31))
    first, again = (sum(row.iterations for row in p.statistics) for p in (before, after))
    assert again < first / 2
    assert [row.stage for row in after.statistics] == ["direct, neighbour, held Gauss-Newton"]
    assert after.whole_body.schedule.apart == before.whole_body.schedule.apart
    assert audit(after.tape, after.robot, after.task).passed


AHEAD = JumpTask(0.4, 0.3)


@pytest.fixture
def doubted(monkeypatch, bhr):
    """(how to plan even jumps from a neighbour or not at all, such a plan, how to say what is used of limits).

    The last number that is said stands for all further motions.
    """
    body = Body(bhr)
    last = partial(WholeBodyPlanner(bhr, body=body, free=even(body)).plan, starts=FROM_NEIGHBOUR)
    known = planner().plan(AHEAD, "direct").whole_body
    assert known.used <= 1 and last(AHEAD, near=known).used <= 1

    def said(*shares: float) -> None:
        told = chain(shares, repeat(shares[-1]))
        monkeypatch.setattr(ended, "used_between", lambda tape, robot, surface, body: next(told))

    return last, known, said


def test_a_plan_that_passes_limits_between_the_nodes_is_settled_and_then_solved_again_on_a_finer_mesh(doubted):
    last, known, said = doubted
    first, plans = last(AHEAD, near=known).solution, []
    for shares in ((1.2, 0.9), (1.2, 1.2, 0.9), (1.2, 1.3)):
        said(*shares)
        plans.append(last(AHEAD, near=known))
    settled, finer, kept = (plan.solution for plan in plans)
    names = [[x.start for x in plan.attempts] for plan in plans]
    both = ["neighbour", "settled", "finer mesh"]
    every = [*both, "finer mesh", "finer mesh"]
    assert names == [["neighbour", "settled"], both, every + every]
    mesh = list(Mesh().intervals().values())
    assert [len(x.j) for x in settled.phases.values()] == mesh
    assert settled.statistics.objective < first.statistics.objective
    assert [len(x.j) for x in finer.phases.values()] == [np.ceil(FINER * n) for n in mesh]
    assert kept.statistics.objective == first.statistics.objective  # none is any better: the first stands
    assert plans[2].used == 1.2


def test_a_start_after_a_mesh_that_was_too_coarse_begins_on_the_finer_one(doubted):
    last, known, said = doubted
    said(*[1.6] * len(["neighbour", "settled", *["finer mesh"] * 3]), 0.9)
    plan = last(AHEAD, near=known)
    assert [x.start for x in plan.attempts].count("neighbour") == 2 and plan.used == 0.9
    assert [len(x.j) for x in plan.phases.values()] == [np.ceil(FINER * n) for n in Mesh().intervals().values()]


@pytest.mark.parametrize(
    ("late", "shares", "third"),
    [
        (True, (30.0, 20.0, 0.9), "neighbour"),
        (True, (30.0, 2.0, 0.9), "finer mesh"),
        (False, (30.0, 20.0, 0.9), "finer mesh"),
    ],
)
def test_a_motion_far_beyond_the_limits_between_the_nodes_is_not_made_finer_late(
    doubted, monkeypatch, late, shares, third
):
    """With half of the time over, the next start is worth more than a finer mesh, but for a motion that is nearly
    one.
    """
    last, known, said = doubted
    if late:
        monkeypatch.setattr(Program, "left_s", lambda self, asked: asked.spent_s / 2 + 1e-6)
    said(*shares)
    plan = last(AHEAD, near=known)
    assert [x.start for x in plan.attempts] == ["neighbour", "settled", third] and plan.used == 0.9


def test_where_the_patience_is_spent_nothing_more_is_tried(doubted, monkeypatch):
    last, known, said = doubted
    monkeypatch.setattr("jumplab.stages.whole_body.program.PATIENCE_S", 0.0)
    said(1.2)
    assert [x.start for x in last(AHEAD, near=known).attempts] == ["neighbour"]


def test_a_motion_that_breaks_limits_between_the_nodes_is_none(doubted):
    last, known, said = doubted
    said(2.0, 1.9, 1.8)
    said = "^whole body: motions that keep every limit at the nodes break that of distance of links between them, at "
    said += "best by a factor of 1.8, pressed by .*capture window; ask for less, or for a finer mesh$"
    with pytest.raises(SolverError, match=said) as e:
        last(AHEAD, near=known)
    assert len(e.value.violations) == 5


def test_limits_between_the_nodes_are_seen(bhr):
    tape = jump(SIDE).tape
    assert 0.5 < used_between(tape, bhr) <= 1
    limits = [LIMITS[name].limit for name in ("rates against positions", "accelerations against rates")]
    assert limits == [between.RATE_GAP, between.ACCELERATION_GAP]
    assert (between.FRICTION, between.LOADED_N) == (LIMITS["friction used"].limit, METHOD.friction_force_n)
    row, effort = len(tape.t) // 3, bhr.actuators["left_ankle_pitch"]["effort"]
    for name, column, change in (("tau", bhr.joint_names.index("left_ankle_pitch"), effort), ("v", 12, 0.05)):
        moved = getattr(tape, name).copy()
        moved[row, column] += 2 * change
        assert used_between(replace(tape, **{name: moved}), bhr) > 1, name
    diverged = tape.tau.copy()
    diverged[5] = np.nan
    assert used_between(replace(tape, tau=diverged), bhr) == np.inf
    (ahead, _, below), down = tape.f[row, 0, [0, 1, 2]], -bhr.foot.tip[2]  # on a flat foot that looks ahead
    assert np.all(tape.extra["contacts"][row] == FLAT)
    for share in (0.99, 1.01):
        pushed = tape.f.copy()
        aside = share * between.FRICTION * below
        pushed[row, 0, :2] = 0.0, aside
        pushed[row, 0, 3:5] += down * (aside - tape.f[row, 0, 1]), down * ahead  # the CoP stays
        used = used_between(replace(tape, f=pushed), bhr)
        assert (used <= 1) == (share < 1) and used >= share - 1e-9
    for share in (0.9, 1.5):
        pushed = tape.f.copy()
        pushed[row, 0, 4] = (
            -down * ahead - (bhr.foot.toe + share * between.PRESSURE_GAP) * below
        )  # the CoP beyond the toes
        used = used_between(replace(tape, f=pushed), bhr)
        assert used == pytest.approx(max(share, used_between(tape, bhr)), abs=1e-6)


def test_soles_that_are_low_between_the_nodes_are_seen(bhr):
    """2 cm in the middle of a flight as the audit asks, 1 mm in the ground elsewhere; also on a platform."""
    asked = 1e-3 * LIMITS["foot clearance"].limit, 1e-3 * LIMITS["penetration"].limit, tuple(METHOD.mid_flight)
    assert (between.CLEAR_M, between.SUNK_M, between.MIDDLE) == asked
    plan = jl.plan(jl.JumpTask(0.6, 0.4, 0.15), bhr)
    tape, body = plan.tape, plan.whole_body
    surface = Surface(0.15, bhr.foot.toe - float(bhr.foot.center[0]) + body.edge_m)
    assert body.used == pytest.approx(used_between(tape, bhr, surface), abs=1e-9) and body.used <= 1
    flying = np.flatnonzero(tape.phase == "flight")
    for part, low, depth in ((0.5, between.CLEAR_M, 0.001), (0.99, 0.0, 0.002)):
        k = flying[int(part * len(flying))]
        moved = tape.q.copy()
        moved[k, 2] -= _lowest(bhr, tape.q[k], surface) - low + depth
        assert np.isclose(_lowest(bhr, moved[k], surface), low - depth)
        alone = replace(tape, q=moved)
        assert between.shares_between(alone, bhr, surface)["height of the soles"] > 1
    for lift in (0.0005, 0.002, -0.002):  # a touchdown above or below the ground
        moved = tape.q.copy()
        moved[-1, 2] += lift
        used = used_between(replace(tape, q=moved), bhr, surface)
        assert (used > 1) == (abs(lift) > between.SUNK_M) and used >= abs(lift) / between.SUNK_M - 0.01
    assert used_between(tape, bhr, replace(surface, edge_m=surface.edge_m - 0.3)) > 1


def _lowest(robot: jl.Robot, q: np.ndarray, surface: Surface) -> float:
    """Least height of the soles' corners over the ground [m]."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    frames = [data.oMf[robot.model.getFrameId(name)] for name in robot.foot.frames]
    points = np.array([f.act(corner) for f in frames for corner in robot.foot.corners])
    return float((points[:, 2] - surface.below(points)).min())


def test_own_weights_and_terms_reach_it(bhr):
    def still(p):
        return ca.vertcat(p.joint_rates.left_shoulder_pitch, p.joint_rates.right_shoulder_pitch)

    arms = jl.Term("still arms", "ours", "rad/s", "node", still, weight=1.0)
    mine = Planner(bhr, terms={"whole body/launch": [arms], "whole body/flight": [arms]})
    plan = mine.plan(SIDE, "direct", weights={"whole body/flight/torque": 0.01})
    assert plan.weights["whole body"]["flight/torque"] == 0.01
    assert plan.weights["whole body"]["flight/still arms"] == 1.0
    rows = [6 + bhr.joint_names.index(f"{side}_shoulder_pitch") for side in ("left", "right")]
    swings = [np.abs(p.tape.v[:, rows]).max() for p in (jump(SIDE), plan)]
    assert swings[1] < swings[0] / 2


def test_points_know_the_robot_by_name(bhr):
    b = Mode(Body(bhr), Limits(), Weights(), "-")
    names = {"q": b.coordinates, "v": b.coordinates, "a": b.coordinates, "z": b.states}
    known = {key: ca.SX.sym(key, len(x)) for key, x in names.items()}
    constants = SimpleNamespace(**{f"{k}_{x}": ca.SX.sym(k + x) for k in ("com", "vel", "L") for x in "xyz"})
    time, more = ca.SX.sym("t"), SimpleNamespace(gravity=9.8)
    p = Point(**known, j=None, duration=time, s=1.0, c=constants, p=more, ref=None, view=partial(Instant, b))
    knee = BASE + bhr.joint_names.index("left_knee")
    assert ca.is_equal(p.joints.left_knee, known["q"][knee])
    assert ca.is_equal(p.joint_rates.left_knee, known["v"][knee])
    assert p.com.shape == p.com_velocity.shape == p.L.shape == p.attitude.shape == p.point("left_knee").shape == (3, 1)
    assert p.torques.knee.shape == (2, 1) and all(x.is_zero() for x in p.feet_forces) and p.wrench.is_zero()
    said = refused(p.point, "elbow")
    assert said.startswith("the robot has no point 'elbow'; it has left_ankle_pitch, left_ankle_roll")


def test_platforms_that_would_lie_under_a_sole_are_refused():
    said = "platform = 0.2 m at a distance of 0.3 m: the two surfaces would meet under a sole of bhr; the "
    said += "distance must be at least 0.35 m"
    assert refused(planner().plan, replace(SIDE, platform_m=0.2), "direct", by=InfeasibleError) == said
    surface_of_jump(Body(jl.Robot.load()), Limits(), replace(SIDE, side_m=0.35, platform_m=0.2))


def test_it_begins_in_the_posture_in_which_the_robot_waits(bhr):
    start = stance_angles(bhr.with_stance(knee_rad=0.6))
    plan = planner().plan(SIDE, "direct", start=start)
    assert plan.tape.q[0, 7:] == pytest.approx(configuration(bhr, start)[7:], abs=1e-3)
    assert plan.planned_side_m == pytest.approx(0.3, abs=2e-3) and np.abs(plan.tape.v[0]).max() < 1e-3


@pytest.fixture
def refusing(monkeypatch):
    """(stage, what it was asked for): nothing is solved."""
    tried = []

    def solve(program, asked, start, begin=None, *, explain=False):
        tried.append((start.name, start.held, explain))
        raise SolverError("spatial: no plan", stage="spatial", violations=("flight/capture window by 1 m",) * explain)

    monkeypatch.setattr(Program, "solve", solve)
    return planner().stage("direct"), tried


STARTS = [("ramp", True), ("schedule", True), ("schedule", False), ("stance", False)]


@pytest.mark.parametrize("read", [True, False])
@pytest.mark.parametrize("near", [True, False])
def test_all_starts_are_tried_and_a_refusal_is_explained_to_who_reads_it(near, read, request):
    """Without a reader of the reason, the refusal comes sooner."""
    known = jump(SIDE).whole_body if near else None
    last, tried = request.getfixturevalue("refusing")
    token = EXPLAINED.set(read)
    try:
        with pytest.raises(SolverError) as e:
            last.plan(replace(SIDE, side_m=0.9), near=known)
    finally:
        EXPLAINED.reset(token)
    asked = [("neighbour", True), ("neighbour", False)] * near + STARTS[: None if read else 3]
    assert tried == [(*start, False) for start in asked] + [("schedule", False, True)] * read
    assert bool(e.value.violations) == read


def test_a_start_that_leads_nowhere_is_followed_by_the_next(monkeypatch):
    """Each attempt is a row of the plan's statistics, those that failed too."""
    first, *others = COLD
    hasty = replace(first, patience=3)
    monkeypatch.setattr(planning, "ASIDE", (hasty, *others))
    plan = planner().plan(SIDE, "direct")
    attempts = plan.whole_body.attempts
    made = [(x.start, x.hessian) for x in attempts[:2]]
    assert made == [("schedule", "held Gauss-Newton"), ("schedule", "exact")]
    assert (attempts[0].status, attempts[0].iterations) == ("Maximum_Iterations_Exceeded", 3)
    assert attempts[1].iterations > 3 and attempts[1].cpu_s > attempts[0].cpu_s > 0
    rows = [(row.stage, row.iterations, row.solve_s) for row in plan.statistics]
    assert rows == [(f"direct, {x.start}, {x.hessian}", x.iterations, x.cpu_s) for x in attempts]
    assert audit(plan.tape, plan.robot, SIDE).passed


def test_the_servo_asks_for_the_planned_torques_if_it_knows_what_each_foot_carries(bhr):
    tape = jump(SIDE).tape
    servo, player = WholeBodyServo(bhr, substeps=10**6), Playback(tape, bhr)
    effort, worst = bhr.limits.effort, {True: 0.0, False: 0.0}
    for row in range(50, tape.takeoff_index - 5, 50):
        if abs(tape.t[row] - tape.extra["toe_phase_start"]) < 2 * STEP_S:
            continue  # wrenches change within the step
        step = round(float(tape.t[row]) / STEP_S)
        command = player.command(step, tape.q[row], tape.v[row], np.zeros(len(effort)))
        assert command.wrench is not None
        for knows in worst:
            told = command if knows else replace(command, wrench=None)
            off = servo.torque(told, tape.q[row], tape.v[row]) - command.tau
            worst[knows] = max(worst[knows], float(np.abs(off / effort).max()))
    assert worst[True] < 0.03 < worst[False] / 2  # on the toes their line moves a little in the plan


def test_targets_out_of_the_plane_are_checked():
    assert JumpTask(0.5, 0.4).in_plane and not SIDE.in_plane and not TURN.in_plane
    for wrong, sentence in (
        ({"side_m": 4}, "side = 4 m is outside -3 ... 3 m"),
        ({"yaw_rad": 7}, "yaw = 7 rad is outside -6.28319 ... 6.28319 rad"),
        ({"yaw_rad": "left"}, "yaw must be a number in rad, got 'left'"),
    ):
        assert refused(JumpTask, 0.5, 0.4, **wrong) == sentence


@pytest.mark.slow
def test_command_line_plans_and_simulates_a_turn(tmp_path, capsys):
    out = str(tmp_path / "turn")
    asked = ("--distance-m", "0.2", "--height-m", "0.4", "--side-m", "-0.1", "--yaw-deg", "60", "--method", "direct")
    assert main(["plan", *asked, "--out", out]) == 0
    assert "planned: distance 0.200 m, rise 0.400 m, side -0.100 m, turn 60.0 deg" in capsys.readouterr().out
    assert main(["simulate", out]) == 0
    told = json.loads((tmp_path / "turn" / "simulation.json").read_text())
    assert told["side_m"] == pytest.approx(-0.1, abs=0.02) and told["yaw_rad"] == pytest.approx(np.pi / 3, abs=0.06)
    target = json.loads((tmp_path / "turn" / "summary.json").read_text())["target"]
    assert JumpTask(**target) == TURN


@pytest.mark.slow
@pytest.mark.parametrize("task", [JumpTask(0.5, 0.45, 0.15, side_m=0.4), JumpTask(0.5, 0.4, 0.15, yaw_rad=0.5)])
def test_platforms_lie_along_the_travel(task):
    plan = jump(task)
    assert jl.audit(plan).passed
    result = jl.simulate(plan)
    assert result.landed and abs(result.q[-1, 2] - plan.tape.q[0, 2] - task.platform_m) < 0.02
    m = result.metrics
    assert np.hypot(m.foot_distance_m - task.distance_m, m.side_m - task.side_m) < 0.02


def test_a_wrong_apex_has_a_direction(bhr):
    """Tipped to the left, faster along the way: the velocity of the CoM and its place are otherwise the same."""
    tape, gauge = jump(TURN).tape, Gauge(bhr)
    _, q, v = WrongApex().apex(tape, bhr)
    _, tipped, faster = WrongApex(1.2, 0.1, direction_rad=np.pi / 2).apex(tape, bhr)
    assert gauge.com(tipped) == pytest.approx(gauge.com(q), abs=1e-9)
    speed = gauge.motion(q, v).velocity
    assert gauge.motion(tipped, faster).velocity == pytest.approx(speed * [1.2, 1.2, 1.0], abs=1e-9)
    axis = TURN.yaw_rad + np.pi / 2  # of the heading; turned about the axis a quarter turn to its left, it tips left
    turn = pin.log3(rotation(tipped[3:7]) @ rotation(q[3:7]).T)
    assert turn == pytest.approx(0.1 * np.array([-np.sin(axis), np.cos(axis), 0.0]), abs=1e-3)


# what it is made of -----------------------------------------------------------------------------------------------
def test_derivatives_of_the_program_by_differences():
    """Of all its rows, and of the Lagrangian's slope, along random ways."""
    a, rng, h = walker().nlp.assembled, np.random.default_rng(5), 1e-6
    x, p = pack(a, step()[0].solution.guess()), data_vector(a, rng)
    lam_f, lam_g = 0.7, rng.normal(size=a.n_rows)

    def slope(at):
        return lam_f * a.grad_f(at, p)[1].full().ravel() + sparse(a.jac_g(at, p)[1]).T @ lam_g

    jacobian, upper = sparse(a.jac_g(x, p)[1]), sparse(a.hess_lag(x, p, lam_f, lam_g))
    ways = rng.normal(size=(3, a.size))
    bent = upper @ ways.T + upper.T @ ways.T - upper.diagonal()[:, None] * ways.T
    rows = slopes(lambda at: a.nlp(at, p)[1].full().ravel(), x, h, ways)
    for exact, seen in ((jacobian @ ways.T, rows), (bent, slopes(slope, x, h, ways))):
        np.testing.assert_allclose(exact, seen, rtol=1e-5, atol=1e-6 * np.abs(seen).max())


@pytest.mark.parametrize("mode", ["flat", "toe"])
def test_forces_at_the_soles_are_wrenches_of_the_feet_and_of_the_ground(bhr, mode):
    """In the body's axes in the program, about the world's origin on the tape."""
    b = Mode(Body(bhr), Limits(), Weights(), {"flat": "R", "toe": "r"}[mode])
    rng, side = np.random.default_rng(0), 1
    hold, pitch = np.array([0.3, -0.2, 0.1, 0.7]), 0.4 * (mode == "toe")
    z = rng.uniform(0, 100, b.n_forces)
    chart = np.append(np.zeros(b.nv), [pitch] * (mode == "toe"))
    point = SimpleNamespace(q=ca.DM(chart), z=ca.DM(z))
    told = *Instant(b, point).sole_wrench(side), Instant(b, point).feet_forces[side]
    force, moment, carried = (ca.evalf(ca.SX(x)).full().ravel() for x in told)
    turn = pin.rpy.rpyToMatrix(0.0, pitch, 0.7) @ b.body.axes[side].T  # attitude of the foot's body
    origin = hold[:3] - turn @ b.body.tips[side]
    (ground,) = pressed(b, side, hold, z[None])
    assert ground[:3] == pytest.approx(turn @ force, abs=1e-9)
    assert ground[3:] == pytest.approx(turn @ moment + np.cross(origin, turn @ force), abs=1e-9)
    heading = pin.rpy.rpyToMatrix(0.0, 0.0, -0.7) @ ground[:3]
    assert np.abs(heading[:2]).sum() < b.limits.friction * heading[2]
    assert heading == pytest.approx(carried, abs=1e-9)
    about = ground[3:] - np.cross(hold[:3], ground[:3])  # the middle of the toe edge
    across = np.array([-np.sin(0.7), np.cos(0.7), 0.0])
    assert mode == "flat" or abs(about @ across) < 1e-9


def test_links_that_are_no_neighbours_can_meet(bhr):
    body = Body(bhr)
    names = {frozenset(body.shapes[i].name for i in pair) for pair in body.candidates}
    assert frozenset(("trunk_1", "left_thigh_0")) in names  # pelvis and thigh meet within the joints' ranges
    assert frozenset(("left_foot_0", "right_foot_0")) in names
    assert frozenset(("left_thigh_0", "left_shank_0")) not in names  # neighbours
    assert len(body.shapes) == len({box.name for box in body.shapes})


def test_a_face_keeps_links_apart(bhr):
    """Its distance in the program is that in postures, less the corners' rounding."""
    body = Body(bhr)
    named = {box.name: k for k, box in enumerate(body.shapes)}
    left, right = (named[f"{side}_foot_0"] for side in ("left", "right"))
    ends = [(left, right), (right, left)]
    ways = [Pair(body.shapes[a], body.shapes[b], face) for a, b in ends for face in range(6)]
    q = ca.SX.sym("q", len(body.model.names))
    told = ca.Function("gaps", [q], [ca.vertcat(*(x.gap(SpatialState(body.model, q, q, q)) for x in ways))])
    rng = np.random.default_rng(1)
    charts = body.stance + 0.2 * rng.normal(size=(5, len(body.stance)))
    boxes = placed(body, body.model.to_pinocchio(charts, 0 * charts, 0 * charts)[0])
    sharp = np.concatenate([face_gaps(boxes[a], boxes[b]) for a, b in ends])
    smooth = told.map(5)(charts.T).full()
    assert np.all(sharp >= smooth) and np.all(sharp - smooth < 3 * ROUNDED_M)


def test_links_that_meet_on_a_tape_get_rows_where_they_do(bhr):
    plan, last = jump(SIDE), planner().stage("direct")
    phases = list(plan.whole_body.solution.phases.values())
    intervals, names = [len(p.j) for p in phases], list(plan.whole_body.solution.phases)
    assert too_close(last.body, phases, 0.003) == []
    apart = plan.whole_body.schedule.apart
    problem = plan.whole_body.solution.problem
    rows = {(owner, t.name): t.skip for owner, t in problem.terms() if " apart, face " in t.name}
    asked = {}
    for x in apart:
        asked[names[x.phase], x.pair.key] = x.first, intervals[x.phase] - x.last
    assert rows == asked
    assert apart and plan.statistics[-1].stage == "direct, links apart, held Gauss-Newton"
    q, rolls = phases[2].q.copy(), ("left_hip_roll", "right_hip_roll")
    q[5:8, [BASE + bhr.joint_names.index(name) for name in rolls]] += [-0.3, 0.3]  # legs that cross
    found = too_close(last.body, [*phases[:2], replace(phases[2], q=q)], 0.003)
    assert {x.phase for x in found} == {2}
    assert all(1 <= x.first <= 5 and 7 <= x.last <= intervals[2] for x in found)
    assert any({x.pair.first.name[:5], x.pair.second.name[:5]} == {"left_", "right"} for x in found)
    later = [replace(x, first=x.first + 1, last=x.last + 2) for x in found]
    # they met in spite of their rows, so between the nodes: each asks for more
    assert merged(found, later) == tuple(replace(x, last=x.last + 2, more_m=MORE_M) for x in found)
    beside = [replace(x, first=x.last + 1, last=x.last + 6) for x in found]
    assert merged(found, beside) == tuple(replace(x, last=x.last + 6) for x in found)
    assert merged(apart, ()) == apart


def test_a_tape_that_leaves_its_nodes_may_not_meet_what_they_keep_apart(bhr):
    """Feet that cross on the tape alone, inside and outside of the nodes of their row."""
    plan, body = jump(SIDE), Body(bhr)
    phases, tape = list(plan.whole_body.phases.values()), plan.tape
    left, right = (next(x for x in body.shapes if x.name == f"{side}_foot_0") for side in ("left", "right"))
    rows = [Apart(2, 4, 8, Pair(left, right, 0))]
    assert used_apart(body, rows, phases, tape) < 0 and used_apart(body, [], phases, tape) < 0
    began = sum(p.duration for p in phases[:2])
    step = phases[2].duration / (len(phases[2].t) - 1)
    rolls = [7 + bhr.joint_names.index(f"{side}_hip_roll") for side in ("left", "right")]
    for node, meet in ((6, True), (2, False), (10, False)):
        q = tape.q.copy()
        q[np.ix_(np.abs(tape.t - began - node * step) < 0.5 * step, rolls)] += [-0.2, 0.2]
        assert (used_apart(body, rows, phases, replace(tape, q=q)) > 1) == meet


@pytest.mark.parametrize(("pitch", "roll", "links", "axis"), [(-2.5, 0.0, "trunk_0 thigh", 0), (-1.7, 0.4, "foot", 1)])
def test_links_that_meet_are_kept_where_they_were(bhr, pitch, roll, links, axis):
    """A thigh stays in front of the trunk, and feet beside each other, though in the midst of each other they were
    less deep behind other faces."""
    body = Body(bhr)
    q = np.tile(body.stance, (13, 1))
    way = np.sin(np.linspace(0, np.pi, 13))
    for side, sign in (("left", 1), ("right", -1)):
        q[:, BASE + bhr.joint_names.index(f"{side}_hip_pitch")] += pitch * way
        q[:, BASE + bhr.joint_names.index(f"{side}_hip_roll")] += sign * roll * way
    still = np.zeros_like(q)
    motion = PhaseSolution(np.linspace(0, 1, 13), q, still, still, still[1:], still[:, :1], 1.0, {})
    rows = too_close(body, [motion], 0.003)
    pairs = [x.pair for x in rows]
    kinds = {f"left_{name}_0" if "_" not in name else name for name in links.split()}
    found = [pair.face // 2 for pair in pairs if kinds <= {pair.first.name, pair.second.name}]
    assert found and set(found) == {axis}
    # where they cannot pass each other, they are kept apart as just before they met
    program = WholeBodyPlanner(bhr, body=body).usual
    kept = unpassed(program, Asked(SIDE), [replace(x, more_m=MORE_M) for x in rows]).apart
    ends = [(x.first, x.last, x.more_m) for x in kept]
    assert ends == [(x.first, x.last, 0.0) for x in rows]
    # two meetings that began at one face are one row, whichever faces lead out of them
    x, turned = rows[0], replace(rows[0].pair, face=(rows[0].pair.face + 2) % 6)
    later = replace(x, pair=turned, first=x.last + 1, last=x.last + 3)
    (both,) = unpassed(program, Asked(SIDE), [x, later]).apart
    assert (both.first, both.last, both.pair) == (x.first, x.last + 3, x.before)
    at = {box.name: k for k, box in enumerate(body.shapes)}
    boxes = placed(body, body.model.to_pinocchio(q, still, still)[0])
    for x in kept:
        gaps = face_gaps(*(boxes[at[box.name]] for box in (x.pair.first, x.pair.second)))[x.pair.face]
        assert max(gaps[x.first : x.first + NODES + 1]) > 0


def test_rows_for_links_that_met_stay_where_they_are_on_another_mesh():
    """A neighbour that was solved on a finer mesh, and one on the usual mesh: the same shares of each phase."""
    first, last = jump(SIDE).whole_body, planner().stage("direct")
    contacts = last.program(SIDE).finer.contacts
    fine = WholeBodyPlanner(last.robot, contacts=contacts, body=last.body).plan(SIDE, near=first)
    found = []
    for plan in (first, fine, last.plan(SIDE, near=fine)):
        count = [p.intervals for p in plan.schedule.contacts.phases]
        rows = {(x.phase, x.pair.key): (x.first / count[x.phase], x.last / count[x.phase]) for x in plan.schedule.apart}
        assert rows and all(0 < begin <= end <= 1 for begin, end in rows.values())
        found.append(rows)
    for key, (begin, end) in found[0].items():
        assert all(rows[key][0] <= begin and rows[key][1] >= end for rows in found[1:])


def test_headed_turns_the_robot_about_the_vertical(bhr):
    rng, gauge = np.random.default_rng(0), Gauge(bhr)
    q = pin.randomConfiguration(bhr.model, -np.ones(bhr.model.nq), np.ones(bhr.model.nq))
    q[7:] = rng.uniform(-0.2, 0.2, len(q) - 7)
    seen, turn = headed(q, 0.7), pin.rpy.rpyToMatrix(0.0, 0.0, -0.7)
    assert headed(q, 0.0) is q
    assert rotation(seen[3:7]) == pytest.approx(turn @ rotation(q[3:7]), abs=1e-12)
    assert gauge.com(seen) == pytest.approx(turn @ gauge.com(q), abs=1e-12)
    assert headed(np.stack([q, q]), 0.7)[1] == pytest.approx(seen, abs=1e-12)


def test_pitch_is_told_in_the_own_heading():
    yaw, pitch = np.linspace(0, 3, 200), np.linspace(0, -2 * np.pi, 200)
    q = np.zeros((200, 7))
    for row, (y, p) in enumerate(zip(yaw, pitch, strict=True)):
        q[row, 3:] = pin.Quaternion(pin.rpy.rpyToMatrix(0, 0, y) @ pin.rpy.rpyToMatrix(0, p, 0)).coeffs()
    assert np.unwrap(pitch_of(q)) == pytest.approx(pitch, abs=1e-9)
    assert pitch_of(q[50]) == pytest.approx(pitch[50])


def test_ground_is_seen_along_the_heading(bhr):
    scene, q = Scene.level("platform", {0.5: 0.2}), np.array(jump(SIDE).tape.q[-1])
    aside = replace(scene, along_rad=np.pi / 2)
    assert aside.seen_along(0.0, bhr, q).top_at(3.0) == 0.0  # its edge is 0.5 m to the left, the soles at 0.3 m
    assert aside.seen_along(0.0, bhr, headed(q, -1.5)).top_at(3.0) == 0.0
    half, centre, turn = aside.boxes()[1]
    middle = (0.5 + 20.0) / 2
    assert centre[:2] == pytest.approx([0.0, middle], abs=1e-12) and half[0] == pytest.approx(20.0 - middle)
    assert centre[2] + half[2] == pytest.approx(0.2)
    assert rotation(turn) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert scene.seen_along(0.0, bhr, q) is scene
    assert scene.seen_along(1.0, bhr, q).top_at(3.0) == 0.0
    q[0] += 1.0
    assert scene.seen_along(1.0, bhr, q).top_at(-3.0) == 0.2
