"""Chained jumps: what is refused before any solve, what enters a plan, and chains that stand, wait, and fail."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_chains import planner, rehearsal, waiting
from fixtures_core import jump, refused

from jumplab.control.kinematics import Gauge
from jumplab.errors import InfeasibleError, InputError, SolverError
from jumplab.robot import Robot
from jumplab.robot.stance import configuration, stance_angles
from jumplab.stages.planner import Planner
from jumplab.studies.chain import Course, crouched, run_chain
from jumplab.studies.chain.course import CROUCH
from jumplab.studies.chain.foresight import Ahead, Foresight, posture
from jumplab.studies.chain.pilot import over_feet
from jumplab.task import JumpTask

# ------------------------------------------------------------------------------------------ courses


def test_course_of_numbers():
    course = Course.of([0.6, 0.5, 0.4], 0.3, [0, 0.2, 0.1])
    assert course.count == 3 and [task.height_m for task in course.tasks] == [0.3, 0.3, 0.3]
    assert course.goals_m == pytest.approx((0.6, 1.1, 1.5))
    assert [task.platform_m for task in course.tasks] == pytest.approx([0.0, 0.2, -0.1])
    assert Course.of([0.6, 0.5], [0.3, 0.4]).tasks == (JumpTask(0.6, 0.3), JumpTask(0.5, 0.4))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (([], 0.3), "a chain has 1 ... 50 jumps, this one has 0; give one distance per jump"),
        (([0.6, 0.6], [0.3, 0.3, 0.3]), "3 heights for 2 distances: give one per jump"),
        (([0.6, 0.6], 0.3, [0.1]), "1 platforms for 2 distances: give one per jump"),
        (([0.6, "far"], 0.3), "an entry of distances_m must be a number, got 'far'"),
        (([0.6, True], 0.3), "an entry of distances_m must be a number, got True"),
        (("0.6", 0.3), "distances_m must be a sequence, got '0.6'"),
        (([0.6, float("nan")], 0.3), "an entry of distances_m must be finite, got nan"),
        (([0.6], 0.0), "jump 1 of 1: height = 0 m is outside 0.02 ... 1.5 m"),
        (([0.6, 0.6], 0.3, [0.8, -0.8]), "jump 2 of 2: platform = -1.6 m is outside -1 ... 1 m"),
        (([0.5, 0.5], 0.3, None, [0.1]), "1 sides for 2 distances: give one per jump"),
        (([0.5, 0.5], 0.3, None, None, [1.0] * 3), "3 turns for 2 distances: give one per jump"),
        (([0.5, 0.5], 0.3, [0.1, 0.1], None, [1.0, 0.0]),
         "platforms need a straight course; leave out the platforms, or the sides and turns"),
    ],
)  # fmt: skip
def test_courses_that_cannot_be_meant(arguments, sentence):
    assert refused(Course.of, *arguments) == sentence


@pytest.mark.parametrize(
    ("arguments", "kind", "sentence"),
    [
        (([0.6, 0.25], 0.3, [0.0, 0.2]), InputError,
         "jump 2 of 2: the surface 0.2 m high would begin under the sole that stands 0.25 m before it; place them "
         "0.34 m apart or more, toe to toe"),
        (([0.6, -0.6], 0.3, [0.2, 0.2]), InputError,
         "jump 2 of 2: -0.6 m goes back over the platforms; chains with platforms go forward, backward jumps stay "
         "on the level"),
    ],
)  # fmt: skip
def test_impossible_chains_are_refused_before_any_solve(monkeypatch, arguments, kind, sentence):
    """Neither planner nor simulation is asked."""
    monkeypatch.setattr(Planner, "plan", lambda *a, **k: pytest.fail("a jump was planned"))
    said = refused(run_chain, Course.of(*arguments), Robot.load(), planner=planner(), by=kind)
    assert said.startswith(sentence) and "\n" not in said


def test_jump_without_a_plan_is_named_before_anything_moves(monkeypatch):
    def fail(task, method):
        raise SolverError("stage 1: no plan")

    monkeypatch.setattr(planner(), "plan", fail)
    with pytest.raises(InfeasibleError, match=r"^jump 1 of 1: stage 1: no plan$"):
        run_chain(Course.of([0.55], 0.3), Robot.load(), planner=planner())


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"solve_s": -0.1}, "solve_s = -0.1 s is outside 0 ... 60 s"),
        ({"method": "magic"}, "method 'magic': choose one of three-step, direct"),
    ],
)
def test_settings_that_make_no_sense(arguments, sentence):
    assert refused(run_chain, Course.of([0.6], 0.3), Robot.load(), planner=planner(), **arguments) == sentence


def test_planner_of_another_posture_is_refused():
    with pytest.raises(InputError, match=r"make it for crouched\(robot\)$"):
        run_chain(Course.of([0.6], 0.3), Robot.load(), planner=Planner(Robot.load()))


def test_scene_of_platforms(bhr):
    """Every landing sole, and every sole before a step, has ground of its own level under it, 5 cm beyond its ends."""
    course = Course.of([0.6, 0.5, 0.7, 0.6], 0.3, [0.0, 0.2, 0.2, 0.05])
    scene, foot = course.scene(bhr), bhr.foot
    zero, length = foot.toe - foot.center[0], foot.toe - foot.heel
    for place, level in zip((0.0, *course.goals_m), (0.0, *course.platforms_m), strict=True):
        for x in (place + 0.049, place - length - 0.049):
            assert scene.top_at(zero + x) == level, (place, x)
    (up, high), (down, low) = course.edges(bhr)
    assert (up, high, down, low) == pytest.approx((0.6 + 0.5 - length - 0.05, 0.2, 1.8 + 0.05, 0.05))
    assert Course.of([0.6, -0.3], 0.3).scene(bhr).name == "flat"


# ------------------------------------------------------------------------------------------ postures


def test_crouch_is_a_stance_of_the_same_robot(bhr):
    other = crouched(bhr)
    assert {key: other.stance[key] for key in CROUCH} == CROUCH and other.stance["shoulder_rad"] == 0.0
    assert other.urdf == bhr.urdf and other.hash != bhr.hash and crouched(other).hash == other.hash


def test_robot_that_cannot_crouch_keeps_its_stance(bhr, monkeypatch):
    from jumplab.studies.chain import course

    monkeypatch.setattr(course, "CROUCH", {"knee_rad": 3.0, "trunk_pitch_rad": 0.2})
    assert crouched(bhr) is bhr


def test_gauge_reads_what_a_configuration_was_made_of(bhr):
    gauge, angles = Gauge(bhr), stance_angles(bhr) + np.array([0.0, 0.1, -0.2, 0.15, 0.3])
    q = configuration(bhr, angles, toe=(0.7, 0.2))
    assert posture(bhr, q) == pytest.approx(angles, abs=1e-12)
    assert gauge.toe(q)[[0, 2]] == pytest.approx([0.7, 0.2], abs=1e-12)
    v = np.zeros(bhr.model.nv)
    v[0] = 2.0  # in the base's axes, which are pitched
    speed = gauge.motion(q, v).velocity
    assert np.linalg.norm(speed) == pytest.approx(2.0)


def test_a_plan_begins_in_the_posture_it_is_given(bhr):
    """Cold and warm, in every stage; the tape starts at rest there, and its distance is kept."""
    start = stance_angles(waiting()) + np.array([0.0, 0.02, -0.03, 0.01, 0.05])
    task = JumpTask(0.6, 0.3)
    for plan in (planner().plan(task, start=start), planner().replan(rehearsal()[0], task, start=start),
                 planner().plan(task, "direct", start=start)):  # fmt: skip
        assert posture(waiting(), plan.tape.q[0]) == pytest.approx(start, abs=1e-6), plan.method
        assert np.abs(plan.tape.v[0]).max() < 1e-6
        assert plan.planned_distance_m == pytest.approx(0.6, abs=1e-4)
    with pytest.raises(InputError, match="a flip begins in the stance"):
        planner().plan(JumpTask(0.0, 0.5, rotation_rad=-2 * np.pi), start=start)


# ------------------------------------------------------------------------------------------ heading
def test_a_square_leads_back():
    course = Course.of([0.3] * 4, 0.35, None, None, [np.pi / 2] * 4)
    assert not course.in_plane and course.tasks[1] == JumpTask(0.3, 0.35, yaw_rad=np.pi / 2)
    assert course.goals[:2] == pytest.approx(np.array([[0.3, 0.0, np.pi / 2], [0.3, 0.3, np.pi]]))
    assert course.goals[3] == pytest.approx([0.0, 0.0, 2 * np.pi], abs=1e-12)
    aside = Course.of([0.3, 0.0], 0.3, sides_m=[0.0, 0.2])
    assert aside.goals[1] == pytest.approx([0.3, 0.2, 0.0]) and Course.of([0.3], 0.3, sides_m=[0.0]).in_plane


def test_what_is_missed_is_made_good_in_the_axes_of_each_jump(bhr):
    """A turn of 90 degrees that ends 80 degrees round and 4 cm short: the next begins there and asks for the rest."""
    echo = Echo()
    see = Foresight(Course.of([0.3, 0.3], 0.3, turns_rad=[np.pi / 2] * 2), bhr, echo, (None,) * 3, solve_s=0.1)
    first = see.look(0, 0.5, np.zeros(3))
    stands = np.array([0.26, 0.0, np.radians(80)])
    first.began_at = np.zeros(3)
    see.look(1, 1.5, stands, last=first)
    task, (c, s) = echo.asked[-1][0], (np.cos(stands[2]), np.sin(stands[2]))
    goal = np.array([0.3, 0.3]) - stands[:2]
    assert task.distance_m == pytest.approx(c * goal[0] + s * goal[1] + 0.04)
    assert task.side_m == pytest.approx(c * goal[1] - s * goal[0])
    assert task.yaw_rad == pytest.approx(np.radians(100) + 0.1)  # as much as jumps may be mistaken by


# ------------------------------------------------------------------------------------------ foresight


class Echo:
    """Stands in for a planner: its plan is what it was asked."""

    def __init__(self):
        self.asked = []

    def replan(self, rehearsed, task, start):
        self.asked.append((task, start))
        return type("Plan", (), {"task": task})


def test_what_is_measured_enters_the_next_plan(bhr):
    """Foot place, shortfall, and what forecasts were wrong by, each with the number that arithmetic gives."""
    echo = Echo()
    see = Foresight(Course.of([0.6, 0.6, 0.6], 0.3), bhr, echo, (None,) * 3, solve_s=0.1234)
    first = see.look(0, 0.5, np.array([0.12, 0.0, 0.0]))
    assert echo.asked[-1][0].distance_m == pytest.approx(0.6) and first.solve_s == pytest.approx(0.124)
    assert first.ready_s == pytest.approx(0.624) and not first.air
    # in the air, 0.57 m are foretold: 3 cm short, to be made good and to be expected again
    first.began_at = np.array([0.12, 0.0, 0.0])
    second = see.look(1, 1.5, np.array([0.69, 0.0, 0.0]), True, first)
    assert echo.asked[-1][0].distance_m == pytest.approx(1.2 - 0.57 + 0.03)
    # it stands at 0.56 m: the forecast was 1 cm too far, and the jump 4 cm short
    second.began_at = np.array([0.68, 0.0, 0.0])
    see.learn_place(first, [second], second.began_at)
    third = see.look(2, 3.0, np.array([1.33, 0.0, 0.0]), True, second)
    foretold, place = 1.33 - 0.12, 1.33 - 0.12 - 0.01
    assert (third.foretold[0], third.place_m) == pytest.approx((foretold, place))
    missed = [0.04, 0.66 - (place - 0.56)]
    assert echo.asked[-1][0].distance_m == pytest.approx(1.8 - place + np.mean(missed))


def test_posture_off_the_crouch_enters_within_reason(bhr):
    see = Foresight(Course.of([0.6], 0.3), bhr, echo := Echo(), (None,))
    off = np.array([0.0, 0.02, -0.03, 0.5, 0.04])
    see.learn_posture(configuration(bhr, stance_angles(bhr) + off))
    see.look(0, 0.5, np.zeros(3))
    assert echo.asked[0][1] - stance_angles(bhr) == pytest.approx([0.0, 0.02, -0.03, 0.1, 0.04])


def test_the_trunk_moves_as_planned_over_feet_that_stand_unevenly(bhr):
    """One foot 2 cm ahead of the other and turned by 3 degrees: throughout the launch each foot keeps its place."""
    tape = jump(0.6, 0.3, 0.0, "direct").tape
    model, data = bhr.model, bhr.model.createData()
    frames = [model.getFrameId(name) for name in bhr.foot.frames]

    def between(q):
        """From the left sole to the right one along the ground, in axes that look where both feet do, and the turn."""
        pin.framesForwardKinematics(model, data, q)
        soles = [data.oMf[f].act(bhr.foot.center) for f in frames]
        yaw = [np.arctan2(*data.oMf[f].rotation[1::-1, 0]) for f in frames]
        c, s = np.cos(np.mean(yaw)), np.sin(np.mean(yaw))
        return np.append(np.array([[c, s], [-s, c]]) @ (soles[1] - soles[0])[:2], yaw[1] - yaw[0])

    rng, q = np.random.default_rng(1), tape.q[0].copy()
    hips = [i for i, name in enumerate(bhr.joint_names) if "hip_yaw" in name or name == "left_hip_pitch"]
    q[7:][hips] += rng.uniform(-0.05, 0.05, len(hips))
    asked = between(q)
    assert abs(asked[0]) > 5e-3 and abs(asked[2]) > 0.01
    spline = over_feet(tape, bhr, q)
    for time in (0.0, 0.2, 0.9 * tape.takeoff_time):
        row = np.searchsorted(tape.t, time)
        moved = tape.q[row].copy()
        moved[7:] += spline(tape.t[row])
        pin.framesForwardKinematics(model, data, tape.q[row])
        level = [data.oMf[f].translation[2] for f in frames]
        assert between(moved) == pytest.approx(asked, abs=1e-4 if time == 0 else 2e-3)  # heels rise about turned toes
        assert [data.oMf[f].translation[2] for f in frames] == pytest.approx(level, abs=1e-4)
    even = over_feet(tape, bhr, tape.q[0])
    assert np.abs(even(np.linspace(0, tape.takeoff_time, 50))).max() < 1e-9


def test_a_failure_of_the_planner_is_kept_as_words(bhr):
    class Refusing(Echo):
        def replan(self, rehearsed, task, start):
            raise SolverError("no plan today")

    ahead = Foresight(Course.of([0.6], 0.3), bhr, Refusing(), (None,)).look(0, 0.5, np.zeros(3))
    assert ahead.plan is None and ahead.failure == "no plan today" and not ahead.in_time


def test_in_time_means_before_it_was_needed():
    def plan(needed):
        return Ahead(1, 2.0, True, 0.6, 0.6, np.zeros(5), 0.0, 0.5, 0.5, object(), needed_s=needed)

    assert plan(2.5).in_time and not plan(2.499).in_time and not plan(None).in_time
