"""Quantities that must not change, or change in a known way: worlds moved, turned, mirrored and scaled, flights run
backwards.

Drawn by hypothesis, the same cases in every run. Tapes of random numbers obey these laws as well as good ones do.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump
from fixtures_robots import child
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from test_audit_amounts import JOINTS, random_tape
from test_export_amounts import short

import jumplab as jl
from jumplab.auditing import AuditReport, audit
from jumplab.io.files import open_log
from jumplab.io.folder import read_json, to_json
from jumplab.io.motion import Motion
from jumplab.io.tape import Tape
from jumplab.robot import Robot
from jumplab.robot.legs import Size, size
from jumplab.robot.stance import stance_angles, stance_configuration
from jumplab.stages.whole_body.settings import LIMIT_UNITS, WEIGHT_UNITS, Limits, Weights
from jumplab.task import JumpTask

ROBOT = Robot.load()
FEW = settings(deadline=None, derandomize=True, max_examples=8, database=None, phases=[Phase.generate])
MANY = settings(FEW, max_examples=40)
SEEDS, FACTORS = st.integers(0, 99), st.floats(0.5, 2.0)
HEIGHTS, FINITE = st.floats(0.1, 1.0), st.floats(-1e6, 1e6)
ALONG_X = {"left/right posture", "left/right effort", "penetration", "foot clearance", "body clearance"}
COP = {"CoP in the sole", "CoP at the toe"}  # at the height of the surface below a foot, so along x as well ...
ALONG_X |= COP
FAR_M = 1e3  # ... unless the other surface begins out of reach


@cache
def judged(seed: int) -> AuditReport:
    return audit(random_tape(seed), ROBOT)


def same(found: AuditReport, known: AuditReport, factor=lambda name: 1.0, but=()) -> None:
    """Every check but those named says the same amount, times its factor, at the same sample."""
    for one, other in zip(found.checks, known.checks, strict=True):
        if one.name not in but:
            expected = factor(one.name) * other.value
            assert one.value == pytest.approx(expected, rel=1e-6, abs=1e-8), one.name


# task -----------------------------------------------------------------------------------------------------------
@MANY
@given(HEIGHTS, FACTORS, st.floats(0.8, 20.0), st.floats(-0.9, 0.9))
def test_jumps_of_giants_and_of_dwarfs(height, size, gravity, share):
    """Froude: lengths times a factor take its root as long, at its root times the speed; gravity the other way."""
    one, other = JumpTask(0.5, height, gravity=gravity), JumpTask(0.5, height * size * 0.7, gravity=gravity)
    size, rise = other.height_m / one.height_m, share * one.height_m
    assert other.takeoff_speed == pytest.approx(math.sqrt(size) * one.takeoff_speed)
    assert other.flight_time(size * rise) == pytest.approx(math.sqrt(size) * one.flight_time(rise))
    heavy = JumpTask(0.5, height, gravity=1.5 * gravity)
    assert heavy.flight_time(rise) == pytest.approx(one.flight_time(rise) / math.sqrt(1.5))


@MANY
@given(HEIGHTS, st.floats(-0.9, 0.9), st.floats(-1.0, 1.0))
def test_a_jump_run_backwards(height, share, distance):
    """From the platform back to the ground, through the same apex: as long in the air."""
    rise = share * min(height, 0.9)
    back = JumpTask(-distance, height - rise, platform_m=-rise)
    assert back.flight_time(-rise) == pytest.approx(JumpTask(distance, height, rise).flight_time(rise))


# robot ----------------------------------------------------------------------------------------------------------
@FEW
@given(st.sampled_from(["thigh", "foot", "arm"]), FACTORS, st.floats(0.3, 1.5))
def test_left_and_right_count_alike(part, mass, effort):
    left, right = (
        ROBOT.with_mass(f"{side}_{part}", factor=mass).with_limits(effort={f"{side}_knee": effort}).sagittal
        for side in ("left", "right")
    )
    for name in ("mass", "inertia", "effort", "speed", "lower", "upper", "span"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), rtol=1e-12, err_msg=name)


def grown_robot(size: float) -> Robot:
    """That of the texts alone, which have no source."""
    urdf, config = child(size)
    begin, end = config.index("[source]"), config.index("[joints]")
    return Robot.from_text(urdf, config[:begin] + config[end:])


@FEW
@given(FACTORS)
def test_a_robot_of_another_size(size):
    """Every length, mass and inertia of the five links, and the stance's angles, of the same material."""
    other, one = grown_robot(size), ROBOT
    for name, power in (("span", 1), ("mass", 3), ("inertia", 5), ("effort", 4)):
        expected = size**power * np.array(getattr(one.sagittal, name))
        np.testing.assert_allclose(getattr(other.sagittal, name), expected, rtol=1e-8, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(stance_angles(other), stance_angles(one), atol=1e-8)
    assert other.foot.toe == pytest.approx(size * one.foot.toe) and other.total_mass == pytest.approx(42.0 * size**3)


def test_every_length_time_and_weight_is_of_a_size():
    """But for edges of platforms, which are the world's, flights, which depend on gravity, and shares."""
    lengths = {name for name in vars(Limits()) if name.endswith(("_m", "_s"))}
    assert {name for name in lengths if name not in LIMIT_UNITS} == {
        "edge_clearance_m", "edge_smoothing_m", "edge_before_heel_m", "edge_step_m", "flight_s"}  # fmt: skip
    assert set(vars(Weights())) - set(WEIGHT_UNITS) == {"follow_duration"}
    assert size(ROBOT) == Size(1.0, 1.0) and Limits().of_size(size(ROBOT)) == Limits()
    of_child = Limits().of_size(Size(0.3, 0.04))  # the audit's least distance of links, 1 mm, is one for all
    assert of_child.link_distance_m == 0.002 and of_child.clearance_m < Limits().clearance_m


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.42, 1.5])
def test_small_and_large_robots_jump_alike(size):
    """Of 3 and of 142 kg, with the same settings: the same jump in the robot's own lengths, times and forces."""
    slow = math.sqrt(size)
    robot, task = grown_robot(size).with_limits(speed=1 / slow), JumpTask(0.6 * size, 0.3 * size)
    plan, usual = jl.plan(task, robot), jump(0.6, 0.3, method="direct")
    assert audit(plan.tape, robot, task).passed
    assert plan.tape.t[-1] / slow == pytest.approx(usual.tape.t[-1], rel=0.01)
    assert np.abs(plan.tape.tau).max() / size**4 == pytest.approx(np.abs(usual.tape.tau).max(), rel=0.02)
    run = jl.simulate(plan, engine="mujoco")
    assert run.landed, run.reason
    assert run.metrics.foot_distance_m == pytest.approx(task.distance_m, abs=0.01 * size)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "asked"), [
    (0.42, {"distance_m": 0.4, "height_m": 0.4, "platform_m": 0.2}),
    (0.42, {"distance_m": 0.0, "height_m": 0.5, "rotation_rad": -2 * math.pi}),
    (1.5, {"distance_m": 0.3, "height_m": 0.3, "side_m": 0.2}),
], ids=["small, up", "small, backflip", "large, aside"])  # fmt: skip
def test_small_and_large_robots_keep_limits_of_their_size(size, asked):
    """Up, over and aside, with the same settings; and the audit sees a CoP that leaves a small sole."""
    robot = grown_robot(size).with_limits(speed=1 / math.sqrt(size))
    plan = jl.plan(JumpTask(**{k: v * size if k.endswith("_m") else v for k, v in asked.items()}), robot)
    assert plan.audit.passed, plan.audit.line()
    f = np.array(plan.tape.f)
    f[..., 4] -= (robot.foot.toe - robot.foot.heel) * f[..., 2]  # a whole sole further ahead
    found = audit(replace(plan.tape, f=f), robot, plan.task)
    assert not found["CoP in the sole"].passed
    assert found["foot clearance"].limit == pytest.approx(20 * size)


# tape -----------------------------------------------------------------------------------------------------------
def placed(x: Tape, place: pin.SE3) -> Tape:
    """A tape in another place of the world, turned about the vertical."""
    q = np.array(x.q)
    turn = pin.Quaternion(place.rotation)
    for row in q:
        row[:3], row[3:7] = place.act(row[:3]), (turn * pin.Quaternion(row[3:7])).coeffs()
    f = np.einsum("ij,nkcj->nkci", place.rotation, x.f.reshape(*x.f.shape[:2], 2, 3)).reshape(x.f.shape)
    return replace(x, q=q, f=f)


@FEW
@given(SEEDS, FINITE.map(lambda x: x / 1e5), FINITE.map(lambda x: x / 1e5))
def test_the_world_moved(seed, x, y):
    same(audit(placed(random_tape(seed), pin.SE3(np.eye(3), np.array([x, y, 0.0]))), ROBOT), judged(seed))


@FEW
@given(SEEDS, st.floats(-3.1, 3.1))
def test_the_world_turned(seed, yaw):
    """The edge of a platform is counted along x, and a tilt to the left from the x-z plane; nothing else is."""
    place = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.zeros(3))
    found = audit(placed(random_tape(seed), place), ROBOT)
    same(found, judged(seed), but=ALONG_X)
    # one of both grounds alone, at the height of the start or of the end, whichever way is ahead
    tapes = random_tape(seed), placed(random_tape(seed), place)
    both = [[audit(x, ROBOT, edge_m=edge) for edge in (-FAR_M, FAR_M)] for x in tapes]
    for name in COP:
        one, other = (sorted(report[name].value for report in reports) for reports in both)
        assert one == pytest.approx(other, rel=1e-6, abs=1e-8), name


def mirror_image(x: Tape) -> Tape:
    """Left is right: y of vectors, x and z of axial vectors, and the joints that turn about x or z change signs."""
    other = [JOINTS.index(n.replace("left_", "*").replace("right_", "left_").replace("*", "right_")) for n in JOINTS]
    sign = np.array([-1.0 if n.endswith(("yaw", "roll")) else 1.0 for n in JOINTS])
    vector, axial = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
    twist = np.concatenate([vector, axial])
    q, joints = np.array(x.q), sign * x.q[:, 7:][:, other]
    q[:, :7] *= [*vector, *axial, 1.0]
    v, a = (np.hstack([twist * y[:, :6], sign * y[:, 6:][:, other]]) for y in (x.v, x.a))
    tau, f = sign * x.tau[:, other], twist * x.f[:, ::-1]
    return replace(x, q=np.hstack([q[:, :7], joints]), v=v, a=a, tau=tau, f=f)


@FEW
@given(SEEDS)
def test_left_and_right_exchanged(seed):
    found = audit(mirror_image(random_tape(seed)), ROBOT)
    same(found, judged(seed))
    swap = {"left_foot": "right_foot", "right_foot": "left_foot"}
    for name in ("friction used", "CoP in the sole", "toe slip", "no force in flight"):
        (there,), (here,) = (re.findall(r"worst: (\w+)$", report[name].note) for report in (found, judged(seed)))
        assert there == swap[here], name


@FEW
@given(SEEDS, FACTORS)
def test_all_masses_scaled(seed, factor):
    """With forces and torques that grow alike, all that is a share or a motion stays, and momentum grows alike."""
    tape, links = random_tape(seed), re.findall(r'<link name="(\w+)"', ROBOT.urdf)
    robot = ROBOT.with_mass(links, factor=factor).with_limits(effort=factor)
    grows = {"angular impulse", "angular momentum in flight", "no force in flight", "ground only pushes"}
    by_size = {"CoP in the sole", "CoP at the toe", "torsional friction", "friction used"}  # count from some newtons on
    found = audit(replace(tape, f=factor * tape.f, tau=factor * tape.tau), robot)
    same(found, judged(seed), lambda name: factor if name in grows else 1.0, but=by_size)


SHARES = ("base force residual", "joint torque consistency", "linear impulse", "gravity in flight",
          "zero force at take-off", "free fall at take-off", "energy balance", "mass", "joint speed", "joint torque",
          "torque at speed", "joint range", "unit quaternion")  # fmt: skip
LENGTHS = ("ballistic CoM", "toe slip", "toe on the ground", "base moment residual", "zero moment at take-off")


@FEW
@given(SEEDS, FACTORS)
def test_a_giants_tape(seed, size):
    """Froude: lengths grow, times by the root, masses by the cube; shares stay, lengths grow."""
    x, slow = random_tape(seed), math.sqrt(size)
    q = np.array(x.q)
    q[:, :3] *= size
    v = np.hstack([x.v[:, :3] * slow, x.v[:, 3:] / slow])
    a = np.hstack([x.a[:, :3], x.a[:, 3:] / size])
    f = x.f * size ** np.array([3, 3, 3, 4, 4, 4])
    grown = replace(x, t=x.t * slow, q=q, v=v, a=a, tau=x.tau * size**4, f=f)
    found = audit(grown, grown_robot(size).with_limits(speed=1 / slow))
    for name in (*SHARES, *LENGTHS):
        expected = judged(seed)[name].value * (size if name in LENGTHS else 1.0)
        assert found[name].value == pytest.approx(expected, rel=1e-6, abs=1e-8), name


def top(speed, spin) -> Tape:
    """A stiff robot that is thrown: 40 ms in the air, after a launch that is none."""
    model, middle, n = ROBOT.model, stance_configuration(ROBOT), 41
    com = pin.centerOfMass(model, model.createData(), middle)
    speed, omega, fall = np.array(speed), np.array([0.0, spin, 0.0]), np.array([0.0, 0.0, -9.8])
    tape = random_tape(0)
    t = np.concatenate([tape.t[:12], tape.t[11] + np.arange(n) / 1000])
    q, v, a = np.tile(middle, (12 + n, 1)), np.zeros((12 + n, model.nv)), np.zeros((12 + n, model.nv))
    for i in range(n):
        since, rest = i / 1000, pin.Quaternion(middle[3:7])
        turn = pin.Quaternion(pin.exp3(omega * since))
        r, body = turn.matrix() @ (middle[:3] - com), (turn * rest).matrix().T
        now = speed + fall * since + np.cross(omega, r)
        q[12 + i, :3], q[12 + i, 3:7] = com + speed * since + fall * since**2 / 2 + r, (turn * rest).coeffs()
        v[12 + i, :3], v[12 + i, 3:6] = body @ now, body @ omega
        a[12 + i, :3] = body @ (fall + np.cross(omega, np.cross(omega, r)) - np.cross(omega, now))
    phase, still = np.array(["launch"] * 12 + ["flight"] * n), (12 + n, model.nv - 6)
    return replace(tape, t=t, q=q, v=v, a=a, tau=np.zeros(still), f=np.zeros((12 + n, 2, 6)), phase=phase)


@FEW
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.floats(-15.0, 15.0))
def test_a_flight_run_backwards(speed, spin):
    """Free flight is free flight in both directions of time, and what bends it is found in both."""
    flight, there = top(speed, spin), slice(12, None)
    back = {name: np.array(getattr(flight, name)) for name in ("q", "v", "a")}
    for name, sign in (("q", 1.0), ("v", -1.0), ("a", 1.0)):
        back[name][there] = sign * back[name][there][::-1]
    names = ("ballistic CoM", "gravity in flight", "angular momentum in flight")
    for tape in (flight, replace(flight, **back)):
        found = audit(tape, ROBOT)
        assert all(found[name].value < 1e-6 for name in names) and found["re-integrated positions"].passed
        bent = np.array(tape.q)
        bent[there, 2] += 0.5 * np.arange(41) ** 2 * 1e-6  # as if it fell with 8.8 m/s^2
        bent = audit(replace(tape, q=bent), ROBOT)
        assert bent["gravity in flight"].value == pytest.approx(100 / 9.8, rel=1e-3)
        assert bent["ballistic CoM"].value == pytest.approx(0.5 * 1.6, rel=1e-3)


@FEW
@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8), st.floats(-3.1, 3.1), st.floats(-5.0, 5.0))
def test_motions_backwards_and_elsewhere(shares, yaw, x):
    """Between its samples a motion is the same backwards, and where it is moved to; later by any time."""
    motion, times = short(), 0.5 + 0.0205 * np.array(sorted(shares))
    keep = np.arange(len(motion.t)) != 10  # each instant once
    once = Motion(*(getattr(motion, k)[keep] for k in ("t", "q", "v", "tau", "phase")), "plan")
    known = once.at(times)
    ends = once.t[0] + once.t[-1]
    back = replace(once, t=ends - once.t[::-1], q=once.q[::-1], v=once.v[::-1], tau=once.tau[::-1])
    mirrored = back.at(np.clip(ends - times[::-1], back.t[0], back.t[-1]))
    place = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.array([x, 1.0, 0.0]))
    moved = replace(once, q=np.array([[*pin.SE3ToXYZQUAT(place * pin.XYZQUATToSE3(q[:7])), *q[7:]] for q in once.q]))
    late = replace(once, t=once.t + 2.0).at(times + 2.0)
    for i, q in enumerate(known.q):
        for other, expected in ((mirrored.q[-1 - i], q), (late.q[i], q), (moved.at(times).q[i], None)):
            if expected is None:
                expected = [*pin.SE3ToXYZQUAT(place * pin.XYZQUATToSE3(q[:7])), *q[7:]]
            np.testing.assert_allclose(pin.difference(ROBOT.model, np.array(expected), other), 0.0, atol=1e-8)
    np.testing.assert_allclose(mirrored.tau[::-1], known.tau, atol=1e-6)


# store ----------------------------------------------------------------------------------------------------------
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda x: st.lists(x, max_size=3) | st.dictionaries(st.text(), x, max_size=3),
    max_leaves=8,
)


@MANY
@given(data=st.dictionaries(st.text(), PLAIN, max_size=4))
def test_what_is_stored_comes_back(tmp_path_factory, data):
    """Whatever JSON can say, in numbers that are bit for bit the same."""
    path = tmp_path_factory.getbasetemp() / "data.json"
    path.write_text(to_json(data), encoding="utf-8", errors="surrogatepass")
    assert read_json(path) == json.loads(json.dumps(data))


@FEW
@given(names=st.lists(st.from_regex(r"own_[a-z]{1,9}", fullmatch=True), unique=True, max_size=4), seed=SEEDS)
def test_a_tape_comes_back_bit_for_bit(tmp_path_factory, names, seed):
    rng, path = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "plan.npz"
    tape = replace(random_tape(seed), extra={name: rng.normal(size=rng.integers(0, 4, 2)) for name in names})
    tape.save(path)
    back, known = Tape.load(path).arrays(), tape.arrays()
    assert list(back) == list(known)
    for name, values in known.items():
        np.testing.assert_array_equal(back[name], values)


@MANY
@given(rows=st.lists(st.integers(0, 5), max_size=6), share=st.floats(0.0, 1.0), more=st.integers(0, 5))
def test_a_log_that_was_cut_loses_its_last_line_at_most(tmp_path_factory, rows, share, more):
    path = tmp_path_factory.getbasetemp() / "work.jsonl"
    path.unlink(missing_ok=True)

    def opened():
        return open_log(path, "work", lambda x: (x["key"], x["value"]))

    with opened() as log:
        for i, key in enumerate(rows):
            log.add({"key": key, "value": [i, "ü"]})
    whole = path.read_bytes() if rows else b""
    cut = whole[: round(share * len(whole))]
    path.write_bytes(cut)
    with opened() as log:
        left = {key: [i, "ü"] for i, key in enumerate(rows[: cut.count(b"\n")])}
        assert log.done == left
        log.add({"key": more, "value": "new"})
    with opened() as log:
        assert log.done == left | {more: "new"}
