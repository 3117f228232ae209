"""Stage 3 and the direct planner: every named limit on the 1 kHz tape, judged through Pinocchio alone."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, jump, pendulum, planner, replay

from jumplab.auditing import audit
from jumplab.errors import SolverError
from jumplab.ocp import Nlp
from jumplab.ocp.nlp import GOOD_STATUSES, OUT_OF_TIME
from jumplab.robot import Robot
from jumplab.stages.changes import StageChanges
from jumplab.stages.whole_body import Limits, Mesh, Weights, WholeBodyPlanner, motions
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import jump_contacts
from jumplab.stages.whole_body.coordinates import even
from jumplab.stages.whole_body.ground import platform_edge_m
from jumplab.stages.whole_body.problem import Schedule
from jumplab.stages.whole_body.starts import GIVEN, IN_PLANE
from jumplab.task import JumpTask

LIMITS, MG = Limits(), 42.0 * 9.8
JUMPS = [(1.0, 0.5, 0.0, "three-step"), (0.6, 0.5, 0.3, "three-step"), (0.8, 0.3, -0.2, "three-step"),
         (1.0, 0.5, 0.0, "direct"), (0.6, 0.5, 0.3, "direct")]  # fmt: skip


@pytest.fixture(params=JUMPS, ids=str, scope="module")
def run(request):
    """A plan whose tape was looked at again; planned once per session."""
    return replay(*request.param)


def sagittal_columns(run, values):
    """(N, 4) left joints hip, knee, ankle, shoulder of an (N, 14) array."""
    names = list(run.tape.joint_names)
    return values[:, [names.index(run.robot.joints[role][0]) for role in LIMBS]]


# solving --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_it_solves(run):
    """The statistics are those of the last attempt, and the tape holds its limits between the nodes too.

    From where a solve begins cold it takes some dozens of steps; there is no coarser mesh before it any more.
    """
    body = run.plan.whole_body
    s = body.solution.statistics
    last = body.attempts[-1]
    assert s.status in GOOD_STATUSES and s.residual < 1e-4
    assert (last.status, last.iterations) == (s.status, s.iterations)
    assert s.iterations <= (50 if last.hessian == "held Gauss-Newton" else 100)
    assert body.used <= 1.0


def test_it_begins_with_what_is_given(run):
    """With stage 2's motion if there is one, else along the schedule; only what fails is followed by another start."""
    body = run.plan.whole_body
    first = IN_PLANE[0] if run.plan.joints is None else GIVEN[0]
    words = "held Gauss-Newton" if first.held else "exact"
    assert (body.attempts[0].start, body.attempts[0].hessian) == (first.name, words)
    assert body.start == first.name
    assert all(x.status not in GOOD_STATUSES for x in body.attempts[:-1])


def test_time_that_other_threads_spent_is_not_its_own(monkeypatch):
    """Ipopt counts that of the process: over, it begins again; the plan is the same, and one attempt."""
    task, solve, with_options = JumpTask(0.4, 0.3), Nlp.solve, Nlp.with_options
    limits = []

    def optioned(nlp, options, hold=None):
        limits.append(options["max_cpu_time"])
        return with_options(nlp, options, hold)

    def late(nlp, **given):
        if len(limits) < 3:
            raise SolverError("no time", status=OUT_OF_TIME, iterations=1)
        return solve(nlp, **given)

    alone = planner().plan(task)
    monkeypatch.setattr(Nlp, "with_options", optioned)
    monkeypatch.setattr(Nlp, "solve", late)
    plan = planner().plan(task)
    assert [x.status for x in plan.attempts] == [x.status for x in alone.attempts]
    np.testing.assert_array_equal(plan.tape.q, alone.tape.q)
    assert [x / limits[0] for x in limits[:3]] == pytest.approx([1.0, 2.0, 4.0])


def test_its_audit_is_clean(run):
    assert audit(run.tape, run.robot, run.plan.task).passed


# dynamics on the tape -------------------------------------------------------------------------------------------
def test_base_residual(run):
    """Six rows that no motor can help, between the nodes too: a millionth of the weight (on a lever of 1 m)."""
    assert np.abs(run.residual[:, :6]).max() < 1e-6 * MG


def test_flight_is_ballistic(run):
    t = run.tape.t[run.flying][:, None] - run.tape.takeoff_time
    com, velocity = run.com[run.flying], run.com_velocity[run.flying]
    parabola = com[0] + t * velocity[0] - np.array([0.0, 0.0, 4.9]) * t**2
    assert np.abs(com - parabola).max() < 1e-9
    assert np.ptp(run.L[run.flying]) < 1e-9
    assert np.abs(run.tape.f[run.flying]).max() == 0.0


# contact --------------------------------------------------------------------------------------------------------
def test_toe_stays_and_nothing_sinks(run):
    launch = ~run.flying
    toe = run.corners[launch][:, :, 2:]
    assert np.abs(toe - toe[0]).max() < 1e-9
    np.testing.assert_allclose(toe[0, ..., 2], 0.0, atol=1e-9)
    assert run.corners[launch][..., 2].min() > -1e-9


# the target -----------------------------------------------------------------------------------------------------
def test_touchdown(run):
    task, corners = run.plan.task, run.corners
    travelled = corners[-1, :, 2:, 0] - corners[0, :, 2:, 0]
    np.testing.assert_allclose(travelled, task.distance_m, atol=1e-4)
    np.testing.assert_allclose(corners[-1, ..., 2], task.platform_m, atol=1e-3)  # flat, and on the surface
    com = run.com[run.flying][:, 2]
    assert com.max() - com[0] == pytest.approx(task.height_m, abs=1e-3)
    planned = np.abs(run.plan.whole_body.phases["flight"].v[-1, 6:]).max()
    assert planned <= LIMITS.touchdown_joint_rate + 1e-3
    # between the nodes L is kept on the tape, to some per mille in the plan; the legs that arrive make up for it
    assert np.abs(run.tape.v[-1, 6:]).max() <= LIMITS.touchdown_joint_rate + 5e-3
    assert abs(run.tape.v[-1, 4]) <= LIMITS.touchdown_trunk_rate + 1e-3
    pitch = 2 * np.arctan2(run.tape.q[-1, 4], run.tape.q[-1, 6])
    assert LIMITS.touchdown_pitch[0] - 1e-3 <= pitch <= LIMITS.touchdown_pitch[1] + 1e-3
    data = run.robot.model.createData()
    pin.forwardKinematics(run.robot.model, data, run.tape.q[-1], run.tape.v[-1])
    for name in run.robot.foot.frames:
        spin = pin.getFrameVelocity(run.robot.model, data, run.robot.model.getFrameId(name)).angular
        assert np.abs(spin).max() <= LIMITS.touchdown_foot_rate + 1e-3
    knee = sagittal_columns(run, run.tape.q[:, 7:])[-1, 1]
    assert LIMITS.touchdown_knee[0] - 1e-3 <= knee <= LIMITS.touchdown_knee[1] + 1e-3
    sole = corners[-1, ..., 0].mean()
    ahead = sole - run.com[-1, 0] - LIMITS.capture_offset_m - LIMITS.capture_slope_s * run.com_velocity[-1, 0]
    assert abs(ahead) <= LIMITS.capture_window_m + 1e-3


def test_hips_that_hardly_bend_land_on_straighter_knees(bhr):
    """With hips that stop 0.1 rad from the stance no knee bends as far as it should at touchdown."""
    robot = bhr.with_limits(joints={"hip_pitch": {"lower": -0.42}})
    plan = WholeBodyPlanner(robot).plan(JumpTask(0.15, 0.12))
    knee = plan.phases["flight"].q[-1, 6 + robot.joint_names.index("left_knee")]
    assert plan.used <= 1 and 0.5 < knee < LIMITS.touchdown_knee[0] - 0.2
    assert Body(bhr).squat_rad > LIMITS.touchdown_knee[1]  # where hips bend, nothing changes


def test_a_refusal_names_the_joints_that_hold_the_jump_back(bhr):
    robot = bhr.with_limits(speed={"hip": 0.15, "knee": 0.15})
    with pytest.raises(SolverError, match="violates flight/vertical take-off speed by") as e:
        WholeBodyPlanner(robot).plan(JumpTask(0.2, 0.3))
    assert str(e.value).endswith(
        "held back by the speed of joint 'left_knee', 3 rad/s and the speed of joint 'left_hip_pitch', 2.7 rad/s"
    )


def test_momentum_follows_stage_one(run):
    """L at take-off within one percent of stage 1's, or within the stated slack where there is little of it."""
    if run.plan.srmp is None:  # the direct planner has no reference: its L at take-off is what the flight keeps
        assert np.ptp(run.L[run.flying]) < 1e-9
        return
    want = run.plan.srmp.launch.L[-1]
    body = run.plan.whole_body
    allowed = max(LIMITS.momentum_share * abs(want), LIMITS.momentum_slack)
    model = run.robot.model
    n = run.robot.model.nv
    last = (x[-1:, :n] for x in (body.phases["toe"].q, body.phases["toe"].v, body.phases["toe"].a))
    q, v, _ = (x[0] for x in body.schedule.body.model.to_pinocchio(*last))
    planned = pin.computeCentroidalMomentum(model, model.createData(), q, v).angular[1]
    assert abs(planned - want) <= allowed + 1e-4
    # on the tape the base moves a little besides, so that the ground's force stays on the toes
    assert abs(run.L[run.tape.takeoff_index] - want) <= allowed + 2e-3
    assert LIMITS.momentum_share <= 0.01


# the problem ----------------------------------------------------------------------------------------------------
def table(tracking):
    """Rows of the problem, of stage 3 or of the direct planner."""
    return (planner().stage("whole body") if tracking else planner().program()).nlp.problem.table()


def test_the_direct_problem_tracks_nothing_and_keeps_every_limit():
    """Friction, CoP and a ground that only pushes are bounds of the forces along the edges of friction pyramids."""
    direct, tracking = ({row["name"] for row in table(kind)} for kind in (False, True))
    assert not any(name.startswith("track") for name in direct)
    assert {"joint range", "joint speed", "forces and torques", "torque-speed", "capture window"} <= direct
    more = {"track inertia", "track inertia rate", "track velocity", "track momentum", "track durations"}
    assert tracking - direct == more | {"ankle rate", "heel velocity", "L at take-off"} and direct < tracking


def test_names_are_unique_within_a_phase():
    for tracking in (True, False):
        names = [(row["phase"], row["name"]) for row in table(tracking)]
        assert len(names) == len(set(names))


def test_a_switched_off_limit_is_gone(bhr):
    """The knees' window at touchdown binds; without it the cost falls, and they are straighter there."""
    usual = jump(1.0, 0.5, 0.0, "direct").whole_body
    body = Body(bhr)
    free = WholeBodyPlanner(bhr, body=body, free=even(body), changes=StageChanges(off=("knees at touchdown",)))
    less = free.plan(JumpTask(1.0, 0.5), near=usual)
    assert less.solution.statistics.objective < 0.99 * usual.solution.statistics.objective
    knees = [
        x.solution.phases["flight"].q[-1, x.schedule.modes[2].coordinates.index("left_knee")] for x in (usual, less)
    ]
    assert knees[0] == pytest.approx(LIMITS.touchdown_knee[0], abs=1e-3) and knees[1] < LIMITS.touchdown_knee[0] - 0.1


def test_edge_of_the_platform(bhr):
    up, down = (platform_edge_m(JumpTask(0.8, 0.5, h), bhr) for h in (0.3, -0.2))
    assert up == pytest.approx(0.8 - 0.24 - LIMITS.edge_before_heel_m)  # a little before the landing heel
    assert down == pytest.approx(LIMITS.edge_before_heel_m)  # a little ahead of the launching toe


def test_plans_say_where_the_ground_steps(run):
    if run.plan.task.platform_m:
        assert run.plan.whole_body.edge_m == pytest.approx(platform_edge_m(run.plan.task, run.robot))


class Taken(Exception):
    """In place of a solve."""


def asked(monkeypatch, stage, *target):
    """Request to a solve: parameters, guess, references and so on, by name."""
    seen = {}

    def solve(self, parameters, guess, **how):
        seen.update(how, parameters=parameters, guess=guess)
        raise Taken

    monkeypatch.setattr(Nlp, "solve", solve)
    with pytest.raises(Taken):
        stage.plan(*target)
    return seen


def test_references_are_stage_ones(monkeypatch):
    srmp, body = pendulum(1.0, 0.5), planner().stage("whole body")
    found = asked(monkeypatch, body, JumpTask(1.0, 0.5), srmp)
    refs = found["references"]
    data = found["parameters"]
    for name, size in (("flat", body.mesh.flat), ("toe", body.mesh.toe), ("flight", body.mesh.flight)):
        assert refs[name]["rho"].shape == (1, size + 1)
    assert refs["flat"]["rho"][0, 0] == pytest.approx(srmp.launch.rho[0])
    assert refs["toe"]["rho"][0, -1] == pytest.approx(srmp.launch.rho[-1])
    assert refs["flat"]["velocity"][:, -1] == pytest.approx(refs["toe"]["velocity"][:, 0])
    np.testing.assert_allclose(refs["toe"]["velocity"][:, -1], srmp.launch.com_velocity[-1])
    np.testing.assert_allclose(refs["flight"]["rho"][0, [0, -1]], srmp.flight.rho[[0, -1]])
    u = np.linspace(0, 1, body.mesh.flight + 1)
    np.testing.assert_allclose(refs["flight"]["left_clearance"][0], LIMITS.clearance_m * (4 * u * (1 - u)) ** 3)
    assert data["momentum"] == srmp.launch.L[-1] and sum(data["launch_s"]) == pytest.approx(srmp.launch_s)


@pytest.mark.parametrize("target", [(1.0, 0.5), (0.6, 0.5, 0.3), (0.8, 0.3, -0.2)])
def test_a_start_keeps_its_place(bhr, target):
    """Toes stand where they are and come down where they should; phases follow each other; all in numbers."""
    body = Body(bhr)
    task = JumpTask(*target)
    schedule = Schedule(body, jump_contacts(LIMITS, Mesh()), LIMITS, Weights(), free=even(body))
    motion = motions.along(schedule, task)
    guess = motions.guess(schedule, task, motion)
    assert [len(g.q) - 1 for g in guess.values()] == list(Mesh().intervals().values())
    for g in guess.values():
        assert all(np.all(np.isfinite(x)) for x in (g.q, g.v, g.a, g.z, *g.constants.values()))
    np.testing.assert_array_equal(motion.charts[0][0], body.stance)
    for before, after in zip(motion.charts, motion.charts[1:], strict=False):
        np.testing.assert_allclose(before[-1], after[0], atol=1e-3)  # inverse kinematics, once from either side
    frames = [bhr.model.getFrameId(name) for name in bhr.foot.frames]
    for k, charts in enumerate(motion.charts):
        rows = charts if k < 2 else charts[-1:]
        way = np.zeros(3) if k < 2 else np.array([task.distance_m, 0.0, task.platform_m])
        data = bhr.model.createData()
        for q in body.model.to_pinocchio(rows, 0 * rows, 0 * rows)[0]:
            pin.framesForwardKinematics(bhr.model, data, q)
            toes = [data.oMf[frame].act(bhr.foot.tip) for frame in frames]
            np.testing.assert_allclose(toes, body.places + way, atol=1e-3)


@pytest.fixture(scope="module")
def refusal(bhr):
    """Refusal of a robot with a fifth of the torque, which cannot jump."""
    urdf = bhr.urdf
    for effort in ("200", "210", "150"):
        urdf = urdf.replace(f'effort="{effort}"', f'effort="{float(effort) * 0.2:g}"')
    robot = Robot.from_text(urdf, bhr.config_text)
    body = Body(robot)
    weak = WholeBodyPlanner(robot, Mesh(8, 6, 8), options={"max_iter": 60}, body=body, free=even(body))
    with pytest.raises(SolverError) as e:
        weak.plan(JumpTask(0.3, 0.3))
    return e.value


@pytest.mark.slow
def test_a_robot_too_weak_is_told_so(refusal):
    """The refusal names terms, amounts and instants, in one sentence: torques, not feet that are off their places,
    which is what the best compromise gives up instead."""
    assert refusal.stage == "whole body" and refusal.violations
    sentence = str(refusal)
    assert "\n" not in sentence and " at t = " in sentence and " by " in sentence
    # what only says that the motion is one motion is no limit that anybody could relax
    links = [t.name for _, t in planner().program().nlp.problem.terms() if t.identity]
    assert "joint dynamics" in links and "base turns" in links
    assert not any(name in sentence for name in links)
    assert "torque" in sentence or "take-off" in sentence


def test_limits_are_read(bhr):
    """Each row of a limb's clearance by its own; knees keep the half thickness of the shank besides.

    Rows of the shanks, which come last, know a platform alone.
    """
    body = Body(bhr)
    found = []
    for least in (LIMITS.body_clearance_m, 0.2):
        limits = Limits(body_clearance_m=least)
        problem = Schedule(body, jump_contacts(limits, Mesh()), limits, Weights(), free=even(body)).problem()
        (term,) = (t for owner, t in problem.terms() if (owner, t.name) == ("flat", "body clearance"))
        assert np.all(np.isinf(term.upper))
        found.append(np.array(term.lower)[:2])
        assert np.all(np.array(term.lower)[2:] == 0)
    assert found[1].min() == 0.2 and found[1] - found[0] == pytest.approx(0.2 - LIMITS.body_clearance_m)
