"""Whole simulated jumps: what they reach, what they measure, and that a failure is called one."""

import functools
import json
import os
import re
import subprocess
import sys

import fixtures_core
import numpy as np
import pytest
from paper.basin import WrongApex

from jumplab.control.controller import level
from jumplab.control.flight import Flight
from jumplab.control.kinematics import Gauge, pitch_of
from jumplab.control.playback import FLAT, Playback
from jumplab.errors import InputError, SolverError
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.sim import (
    INSTALLED,
    STEP_S,
    Perturbation,
    Ranges,
    Scene,
    SensorNoise,
    SimulationResult,
)
from jumplab.sim import simulate_jump as simulate
from jumplab.sim.engine import Log
from jumplab.sim.result import events, record
from jumplab.stages.srmp.landing import LandingPlanner, touchdown_of_state
from jumplab.task import JumpTask

DISTANCE, HEIGHT = 0.6, 0.3
SHORT_S = 0.3  # enough to compare launches and flights


@pytest.fixture(scope="module", params=[("position", INSTALLED[0]), ("pd", INSTALLED[-1])])
def jump(request, bhr, tape):
    mode, engine = request.param
    return simulate(tape, bhr, mode=mode, engine=engine)


@pytest.fixture(scope="module")
def look(bhr, tape):
    """A short look at a jump."""
    return simulate(tape, bhr, stand_s=SHORT_S)


def test_reaches_the_target_and_stands(jump):
    m = jump.metrics
    assert jump.landed and jump.checks_passed, jump.reason
    assert m.foot_distance_m == pytest.approx(DISTANCE, abs=0.02)
    assert m.foot_distance_touchdown_m == pytest.approx(m.foot_distance_m, abs=0.01)
    assert m.com_rise_m == pytest.approx(HEIGHT, abs=0.01)
    assert m.com_apex_m == pytest.approx(jump.com[:, 2].max() - jump.com[0, 2], abs=1e-12)
    assert m.standing_s >= 3
    assert m.self_collision_s == 0 and m.stray_contacts == () and m.qp_failures == 0
    assert m.qp_solves == pytest.approx(125 + 50 * (m.standing_s - 0.5), abs=2)  # rarely, once it is calm


def test_torques_stay_within_the_motors(bhr, jump):
    """At every step, from the log alone: peak torque, and the torque-speed line at the speed of that step."""
    motors = bhr.limits
    low, high = motors.range(jump.v[:, 6:])
    assert (jump.tau <= high + 1e-6).all() and (jump.tau >= low - 1e-6).all()
    m = jump.metrics
    assert m.max_torque_ratio == pytest.approx(np.max(np.abs(jump.tau) / motors.effort))
    assert m.max_torque_ratio_before_touchdown < 0.9
    assert m.max_speed_ratio_before_touchdown < 0.9
    assert set(m.max_torque_ratio_by_joint) == set(bhr.joint_names)
    assert max(m.max_speed_ratio_by_joint.values()) == m.max_speed_ratio
    assert max(m.overspeed_s.values()) == 0 and m.max_torque_ratio < 0.9


def test_measurements_agree_with_mechanics(jump):
    """Rise from v^2 / 2g, launch impulse from the momentum gained, flight on a parabola with constant L."""
    m = jump.metrics
    vx, vz = m.takeoff_velocity
    assert m.com_rise_m == pytest.approx(vz**2 / (2 * 9.8), abs=0.003)
    assert m.launch_impulse[0] == pytest.approx(42 * vx, abs=0.3)
    assert m.launch_impulse[1] - 42 * 9.8 * m.liftoff_s == pytest.approx(42 * vz, abs=1.0)
    air = jump.phase == "flight"
    t = jump.t[air] - jump.t[air][0]
    assert jump.com[air, 0] == pytest.approx(jump.com[air, 0][0] + vx * t, abs=0.005)
    assert jump.com[air, 2] == pytest.approx(jump.com[air, 2][0] + vz * t - 4.9 * t**2, abs=0.005)
    assert np.ptp(jump.L[air]) < 0.05
    assert jump.rho.min() > 1.5 and jump.rho.max() < 9


def test_the_record_is_complete(bhr, tape, jump):
    n = len(jump.t)
    assert np.diff(jump.t) == pytest.approx(STEP_S)
    shapes = {"q": (n, 21), "v": (n, 20), "tau": (n, 14), "foot_wrench": (n, 2, 6), "com": (n, 3), "phase": (n,),
              "com_velocity": (n, 3), "L": (n,), "rho": (n,), "touching": (n, len(jump.link_names))}  # fmt: skip
    arrays = jump.arrays()
    assert {name: arrays[name].shape for name in shapes} == shapes
    assert all(a.dtype != object for a in arrays.values())
    assert not jump.q.flags.writeable
    assert list(dict.fromkeys(jump.phase)) == ["launch", "flight", "landing"]
    assert jump.q[0] == pytest.approx(tape.q[0], abs=1e-9)  # where the tape begins, and untouched ever after:
    speed = np.linalg.norm(jump.com_velocity, axis=1).max()
    assert np.linalg.norm(np.diff(jump.com, axis=0), axis=1).max() < 1.1 * speed * STEP_S  # nothing jumps
    feet = [jump.link_names.index(name) for name in bhr.foot.frames]
    assert not np.delete(jump.touching, feet, axis=1).any()
    assert jump.settings["friction_read_back"] == 0.8
    assert jump.settings["robot_hash"] == bhr.hash


def test_what_was_saved_is_loaded(bhr, look, odd_folder):
    assert SimulationResult.load(odd_folder, bhr) is None
    look.save(odd_folder, {"planned_distance_m": DISTANCE})
    assert sorted(os.listdir(odd_folder)) == ["simulation.json", "simulation.npz"]
    again, path = SimulationResult.load(odd_folder, bhr), odd_folder / "simulation.json"
    before, after = look.arrays(), again.arrays()
    assert before.keys() == after.keys() and all(np.array_equal(before[name], after[name]) for name in before)
    assert (again.metrics, again.checks, again.checks_passed) == (look.metrics, look.checks, True)
    assert again.settings == json.loads(json.dumps(look.settings)) and again.link_names == look.link_names
    assert not again.q.flags.writeable
    said = json.loads(path.read_text())
    assert said["planned_distance_m"] == DISTANCE and said["foot_distance_m"] == look.metrics.foot_distance_m
    assert said["schema"] == str(before["schema"]) and said["settings"]["mode"] == "position"
    older = {k: v for k, v in said.items() if "checks" not in k} | {"honesty": said["checks"]}
    path.write_text(json.dumps(older))
    assert SimulationResult.load(odd_folder, bhr).checks == look.checks
    texts = (text.replace("left_knee", "left_knie") for text in (bhr.urdf, bhr.config_text))
    with pytest.raises(InputError, match="not a simulation of this folder's robot"):
        SimulationResult.load(odd_folder, Robot.from_text(*texts))
    path.unlink()
    for name, content in (("json", None), ("json", b"{"), ("json", b"[]"), ("json", b"{}"), ("npz", b"PK")):
        if content is not None:
            (odd_folder / f"simulation.{name}").write_bytes(content)
        with pytest.raises(InputError, match="not a") as e:
            SimulationResult.load(odd_folder, bhr)
        assert str(odd_folder) in str(e.value) and "\n" not in str(e.value)
    with pytest.raises(InputError, match=r"simulation.json/folder' cannot be written .*choose another one"):
        look.save(path / "folder")


def test_scenes_and_perturbations_need_no_engine():
    code = "import sys; from jumplab.sim import Scene, Perturbation; sys.exit('pybullet' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_same_seed_same_jump(bhr, tape):
    """Everything random is seeded: robot, delay and noise; another seed is another jump."""
    runs = [
        simulate(tape, bhr, perturbation=Perturbation.draw(bhr, s, noise=SensorNoise.typical()), stand_s=0.01)
        for s in (5, 5, 6)
    ]
    assert np.array_equal(runs[0].q, runs[1].q) and np.array_equal(runs[0].tau, runs[1].tau)
    assert len(runs[2].q) != len(runs[0].q) or not np.array_equal(runs[2].q, runs[0].q)
    data = runs[0].settings["perturbation"]
    assert data["seed"] == 5 and len(data["mass"]) == 9 and data["noise"]["gyro"] > 0
    json.dumps(runs[0].to_json())


def test_reaim_leaves_a_good_flight_alone_and_saves_a_bad_one(bhr, tape, look):
    aimed = simulate(tape, bhr, reaim=True, stand_s=SHORT_S).metrics
    assert aimed.foot_distance_touchdown_m == pytest.approx(look.metrics.foot_distance_touchdown_m, abs=0.01)
    tipped = WrongApex(pitch_rad=-np.radians(10))
    assert "touched the ground" in simulate(tape, bhr, disturbance=tipped).reason
    saved = simulate(tape, bhr, disturbance=tipped, reaim=True)
    assert saved.landed and saved.settings["disturbance"]["pitch_rad"] < 0


def test_disturbance_is_what_it_says(bhr, tape):
    (step, q, v), (again, p, u) = (x.apex(tape, bhr) for x in (WrongApex(), WrongApex(1.2, 0.1, 0.05)))
    plain, other = Gauge(bhr).motion(q, v), Gauge(bhr).motion(p, u)
    assert again == step and abs(plain.velocity[2]) < 0.02
    assert other.com - plain.com == pytest.approx([0, 0, 0.05])
    assert other.velocity == pytest.approx(plain.velocity * [1.2, 1.2, 1.0])
    assert other.momentum[1] == pytest.approx(plain.momentum[1])
    assert pitch_of(p) - pitch_of(q) == pytest.approx(0.1)


def test_the_landing_is_planned_in_flight(bhr, tape):
    """By default stage 1's landing is followed, there in time, and needs less torque and force than spring-dampers."""
    planned, spring = (simulate(tape, bhr, landing=name, stand_s=1.0) for name in ("planned", "spring"))
    said = planned.settings["landing"]
    assert said["asked"] == said["followed"] == "planned" and said["reason"] is None
    assert said["planned_at_s"] < planned.metrics.touchdown_s - 0.1
    assert said["time_left_s"] == pytest.approx(planned.metrics.touchdown_s - said["planned_at_s"], abs=0.005)
    assert 0 < said["solve_s"] < 1.0
    assert spring.settings["landing"]["followed"] == "spring" and spring.settings["landing"]["solve_s"] is None

    def loads(run):  # after the impact's first 20 ms
        late = np.flatnonzero(run.phase == "landing")[20:]
        effort = bhr.limits.effort
        return np.max(np.abs(run.tau[late]) / effort), run.foot_wrench[late, :, 2].sum(axis=1).max()

    (torque, force), (spring_torque, spring_force) = loads(planned), loads(spring)
    assert torque < 0.85 * spring_torque and force < 0.8 * spring_force  # 0.81; plans of three steps 0.6 to 0.7


def test_late_commands_make_no_joint_swing(bhr, tape):
    """In the air a light foot must not be driven faster than a delay of 4 ms allows."""
    run = simulate(tape, bhr, mode="pd", perturbation=Perturbation(delay_s=0.004), stand_s=0.01)
    air = (run.t > tape.takeoff_time + 0.1) & (run.t < run.metrics.touchdown_s - 0.03)
    planned = np.stack([np.interp(run.t, tape.t, column) for column in tape.v[:, 6:].T], axis=1)
    assert np.abs(run.v[:, 6:] - planned)[air].max() < 0.5  # [rad/s]; 45 with the gains of the launch


def test_without_a_planned_landing_it_springs_and_says_so(bhr, tape, monkeypatch):
    def refuse(planner, touchdown):
        raise SolverError("no landing: the CoP would have to leave the sole", stage="landing")

    monkeypatch.setattr(LandingPlanner, "plan", refuse)
    said = simulate(tape, bhr, stand_s=SHORT_S).settings["landing"]
    assert (said["asked"], said["followed"]) == ("planned", "spring")
    assert said["reason"] == "no landing: the CoP would have to leave the sole"


def test_the_touchdown_is_foreseen(bhr, tape):
    """From 0.15 s before it, in a jump that differs from the plan: CoM, velocity and momentum at the first contact."""
    run = simulate(tape, bhr, perturbation=Perturbation(delay_s=0.001), stand_s=SHORT_S)
    forecast, gauge = Flight(bhr, tape, level), Gauge(bhr)
    touch = int(np.argmax(run.phase == "landing"))
    early = touch - 150
    now = gauge.motion(run.q[early], run.v[early])
    left = forecast.time_left(now)
    assert left == pytest.approx(0.15, abs=0.003)
    turn = forecast.turn_ahead(early, now, left)
    there = touchdown_of_state(bhr, *forecast.state(now, turn, left), impact=False)
    real = touchdown_of_state(bhr, run.q[touch], run.v[touch], impact=False)
    assert there.com == pytest.approx(real.com, abs=0.01)
    assert there.com_velocity == pytest.approx(real.com_velocity, abs=0.03)
    assert there.L == pytest.approx(real.L, abs=0.05)
    assert there.trunk_pitch == pytest.approx(real.trunk_pitch, abs=0.02)


def test_a_ditch_swallows_a_short_jump_alone(bhr, tape):
    ditches = (Scene.level("ditch", {0.2: -1.0, x: 0.0}) for x in (1.4, 0.4))
    wide, narrow = (simulate(tape, bhr, scene=scene, stand_s=SHORT_S) for scene in ditches)
    assert not wide.landed and "watched" not in wide.reason
    assert "watched" in narrow.reason and narrow.metrics.foot_distance_m > 0.58


def test_a_fall_is_called_a_fall_and_a_short_look_no_landing(bhr, tape, look):
    run = simulate(tape, bhr, disturbance=WrongApex(pitch_rad=0.6))
    assert not run.landed and "touched the ground" in run.reason and run.metrics.standing_s < 3
    assert run.t[-1] < 2.5  # not simulated for longer than it is worth
    assert run.checks_passed
    assert not look.landed and look.reason == "watched for 0.35 s only, not 3 s"


def test_a_wrong_posture_at_the_start_is_led_back_without_tipping(bhr, tape):
    """Joints up to three degrees off: put right at once, the trunk's way there tips the robot over its soles."""
    wrong = Perturbation.draw(bhr, 8, Ranges.none(posture_deg=3.0))
    assert simulate(tape, bhr, perturbation=wrong).landed


def test_playback_leaves_a_wrong_posture_smoothly(bhr, tape):
    off, wrong = 0.04 * np.ones(len(bhr.joint_names)), tape.q[0].copy()
    wrong[7:] += off
    rest, plan, play = np.zeros(len(off)), Playback(tape, bhr), Playback(tape, bhr)
    play.approach(wrong)
    led, due = ([p.command(k, wrong, np.zeros(bhr.model.nv), rest) for k in range(1, plan.steps)] for p in (play, plan))
    gap = np.array([a.q - b.q for a, b in zip(led, due, strict=True)])
    rate = np.array([a.rate - b.rate for a, b in zip(led, due, strict=True)])
    assert np.allclose(gap[0], off, atol=1e-6) and np.abs(rate[0]).max() < 1e-3
    assert np.allclose(np.diff(gap, axis=0) / STEP_S, (rate[1:] + rate[:-1]) / 2, atol=1e-4)
    gone = int(np.flatnonzero((gap == 0).all(axis=1))[0])
    assert {command.feet for command in led[:gone]} == {FLAT} and not gap[gone:].any()
    wrong[7:] += 0.019 - off  # so much do sensors err
    careless = Playback(tape, bhr)
    careless.approach(wrong)
    assert (careless.command(1, wrong, np.zeros(bhr.model.nv), rest).q == due[0].q).all()


def test_a_fall_before_touchdown_is_told_as_one(bhr, tape):
    """Ground so soft that the crouch puts a shank on it: no landing is watched, and the verdict says why."""
    run = simulate(tape, bhr, perturbation=Perturbation.draw(bhr, 0, Ranges.none(soft_m=(0.03, 0.03))))
    assert not run.landed and re.fullmatch(r"\w+ touched the ground 0\.\d\d s before touchdown", run.reason), run.reason


def test_standing_still_is_no_jump(bhr, tape):
    """A tape that never leaves its first posture: the feet stay down, and the verdict says so."""
    rest = {name: np.repeat(getattr(tape, name)[:1], len(tape.t), axis=0) for name in ("q", "tau", "f")}
    still = np.zeros_like(tape.v)
    lazy = Tape(
        tape.t, rest["q"], still, still, rest["tau"], tape.phase, tape.contact_frames, rest["f"], tape.joint_names
    )
    run = simulate(lazy, bhr, stand_s=SHORT_S)
    assert not run.landed and run.reason == "the feet never left the ground"
    assert run.metrics.com_rise_m is None and run.metrics.foot_distance_m is None
    json.dumps(run.to_json(), allow_nan=False)


def force_of(parts) -> np.ndarray:
    """So many rows of each force [N]."""
    return np.repeat([float(f) for _, f in parts], [n for n, _ in parts])


def test_events_from_forces():
    for parts, rows in (
        (((100, 400), (300, 0), (100, 900)), (100, 400)),
        (((10, 400), (20, 0), (70, 400), (300, 4), (9, 900)), (100, 400)),  # a hop, then a jump
        (((100, 400), (300, 0), (10, 900), (200, 0), (10, 300)), (100, 400)),  # a bounce
        (((300, 0), (100, 900)), (0, 300)),  # begun in the air
        (((100, 400), (300, 0)), (100, None)),
        (((100, 400),), None),
    ):
        assert events(force_of(parts), lambda row: np.array([2e-3 * row, 0, 0])) == ([rows] if rows else [])


def test_as_many_flights_as_the_plan_has():
    parts = (100, 400), (300, 0), (50, 900), (200, 0), (10, 300), (100, 0)
    force = force_of(parts)
    rows = [(100, 400), (450, 650), (660, None)]
    for count in (1, 2, 3):
        assert events(force, lambda row: np.array([2e-3 * row, 0, 0]), count) == rows[:count]


def test_a_crouch_that_unloads_the_feet_is_no_flight():
    force = force_of(((100, 9), (200, 0), (80, 90), (300, 0), (9, 90)))
    assert events(force, lambda row: np.array([0, 0, 1e-3 * max(row - 380, 0)])) == [(380, 680)]
    assert events(force, lambda row: np.zeros(3)) == []


MOON, MARS, LOW = JumpTask(1.0, 0.5, gravity=1.62), JumpTask(1.0, 0.5, gravity=3.71), JumpTask(0.1, 0.1)


@functools.cache
def planned(task):
    return fixtures_core.planner().plan(task, "direct")


@pytest.mark.parametrize(
    ("engine", "task"),
    [
        pytest.param(engine, task, id=f"{engine}-{name}", marks=() if name == "moon" else pytest.mark.slow)
        for engine in INSTALLED
        for name, task in {"moon": MOON, "mars": MARS, "low": LOW}.items()
    ],
)
def test_any_gravity_and_size_is_measured_by_a_second_way(bhr, engine, task):
    """Within 2 mm of what CoM, forces and feet of the log say by themselves, and of the plan.

    On the moon the crouch falls as fast as the ground could push, so the feet carry nothing for 0.2 s.
    """
    plan = planned(task)
    tape = plan.tape
    run = simulate(tape, bhr.under_gravity(task.gravity), engine=engine, stand_s=SHORT_S)
    m, force = run.metrics, run.foot_wrench[:, :, 2].sum(axis=1)
    if task is MOON:
        assert (force[: tape.takeoff_index] == 0).sum() > 50
    assert m.liftoff_s == pytest.approx(tape.takeoff_time, abs=0.005)
    assert m.touchdown_s == pytest.approx(float(tape.t[-1]), abs=0.005)
    middle = int(1000 * (tape.takeoff_time + tape.t[-1]) / 2)  # of the flight: feet are off the ground
    loaded = np.flatnonzero(force > 10.0)
    off, down = loaded[loaded < middle][-1] + 1, loaded[loaded > middle][0]
    apex = run.com[off:down, 2].max()
    assert m.com_rise_m == pytest.approx(apex - run.com[off, 2], abs=2e-3)
    assert m.com_rise_m == pytest.approx(run.com_velocity[off, 2] ** 2 / (2 * task.gravity), abs=2e-3)
    assert m.com_apex_m == pytest.approx(apex - run.com[0, 2], abs=2e-3)
    way = ((run.feet[-1] - run.feet[0]) @ [*bhr.foot.tip, 1.0])[:, 0]
    assert m.foot_distance_m == pytest.approx(way.mean(), abs=2e-3)
    assert m.com_rise_m == pytest.approx(plan.planned_rise_m, abs=2e-3)
    assert m.com_apex_m == pytest.approx(plan.planned_apex_m, abs=2e-3)
    assert m.foot_distance_touchdown_m == pytest.approx(plan.planned_distance_m, abs=3e-3)


def test_an_exploded_engine_is_an_error(bhr, tape):
    steps = [np.full(21, np.nan), *map(np.zeros, (20, 14, (2, 6), 3, ()))]
    with pytest.raises(SolverError, match="the engine lost the robot"):
        record(bhr, Log(*(x[None] for x in steps)), ("trunk", *bhr.foot.frames), tape.q[-1])


def stepped(robot, q, right_up):
    """Log of a robot that stands, is carried 0.2 m ahead in the air, and lands on its left foot alone."""
    weight = robot.total_mass * robot.gravity
    down, pushed, left = (np.zeros((2, 6)) for _ in range(3))
    pushed[:, 2], left[0, 2] = weight / 2, weight
    rest = np.zeros(robot.model.nv), np.zeros(robot.model.nv - 6)
    landed = q.copy()
    landed[0] += 0.2
    knee = [list(robot.model.names).index(robot.joints[role][1]) for role in ("hip_pitch", "knee")]
    for joint, bend in zip(knee, (-right_up, 2 * right_up), strict=True):
        landed[robot.model.idx_qs[joint]] += bend
    air = np.repeat(landed[None], 60, axis=0)
    air[:, 0] = q[0] + np.linspace(0.0, 0.2, 60)
    poses = [(q, pushed)] * 20 + [(x, down) for x in air] + [(landed, left)] * 20
    wrench = np.array([wrench for _, wrench in poses])
    feet = np.outer(wrench.any(axis=(1, 2)), [False, True, True])
    still = (np.tile(x, (len(poses), 1)) for x in rest)
    return Log(np.array([x for x, _ in poses]), *still, wrench, feet, np.zeros(len(poses), bool))


def test_toes_at_touchdown_are_those_of_the_feet_that_are_to_land(bhr, tape):
    """On one foot its own way; none where it is not that foot, or not both, that came down."""
    q = tape.q[0]
    names = ("trunk", *bhr.foot.frames)

    def measured(right_up, lands):
        steps = stepped(bhr, q, right_up)
        return record(bhr, steps, names, steps.q[-1], lands=lands).metrics

    one = measured(0.6, (0,))
    assert one.touchdown_s == pytest.approx(0.08) and one.foot_distance_touchdown_m == pytest.approx(0.2)
    assert abs(one.foot_distance_m - 0.2) > 0.01  # the mean of both, of which one is behind
    assert measured(0.6, (1,)).foot_distance_touchdown_m is None
    assert measured(0.6, (0, 1)).foot_distance_touchdown_m is None
    assert measured(0.0, (0, 1)).foot_distance_touchdown_m == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mode": "velocity"}, "mode 'velocity': must be one of position, pd, whole-body"),
        ({"mode": None}, "mode must be a text, got None"),
        ({"contact": "soft"}, "contact 'soft': must be one of hard, usual"),
        ({"contact": None}, "contact None: must be one of hard, usual"),
        ({"landing": "soft"}, "landing 'soft': must be one of planned, spring"),
        ({"stand_s": 0}, r"stand_s = 0 s is outside 0 \.\.\. 60 s"),
        ({"stand_s": float("nan")}, "stand_s must be finite, got nan"),
    ],
)
def test_bad_options(bhr, tape, options, words):
    with pytest.raises(InputError, match=words):
        simulate(tape, bhr, **options)
