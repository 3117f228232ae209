"""The audit's own quantities against closed forms that no planner made, and what it says: report and folder."""

from __future__ import annotations

import dataclasses
import json
import math
import os

import numpy as np
import pinocchio as pin
import pytest
from fixtures_audit import KNEE, LEFT, ROBOT, edit, good_tape, robot_with, with_forces

from jumplab.auditing import AuditReport, Check, audit, contact, write_audit
from jumplab.auditing.dynamics import available_torque
from jumplab.auditing.motion import foot_turn, mirror
from jumplab.auditing.replay import open_tape, replay
from jumplab.auditing.report import Limit
from jumplab.errors import InputError, RobotError
from jumplab.io.tape import Tape
from jumplab.robot.stance import com_from_toe, stance_angles, stance_configuration
from jumplab.task import JumpTask


@pytest.fixture(scope="module")
def good() -> Tape:
    return good_tape()


# ------------------------------------------------------------------------ closed forms, no planner: statue, then top


SPIN, SPEED, AIR = -2 * math.pi / 0.4, np.array([1.0, 0.0, 2.0]), 0.4  # [rad/s], [m/s], [s]: one backward turn


@pytest.fixture(scope="module")
def statue_and_top() -> Tape:
    """0.3 s of standing still, then 0.4 s of flight as one rigid body that turns about +y."""
    model, q0 = ROBOT.model, stance_configuration(ROBOT)
    com = pin.centerOfMass(model, model.createData(), q0)
    arm, rest = q0[:3] - com, pin.Quaternion(q0[3:7])
    t = np.concatenate([np.arange(301) / 1000, 0.3 + np.arange(401) / 1000])
    q, v, a = np.tile(q0, (len(t), 1)), np.zeros((len(t), model.nv)), np.zeros((len(t), model.nv))
    omega, fall = np.array([0.0, SPIN, 0.0]), np.array([0.0, 0.0, -9.8])
    for i in range(301, len(t)):
        since = t[i] - 0.3
        turn = pin.Quaternion(pin.exp3(omega * since))
        r = turn.matrix() @ arm
        speed, body = SPEED + fall * since + np.cross(omega, r), (turn * rest).matrix().T
        q[i, :3], q[i, 3:7] = com + SPEED * since + fall * since**2 / 2 + r, (turn * rest).coeffs()
        v[i, :3], v[i, 3:6] = body @ speed, body @ omega
        a[i, :3] = body @ (fall + np.cross(omega, np.cross(omega, r)) - np.cross(omega, speed))
    phase = np.where(np.arange(len(t)) < 301, "launch", "flight")
    blank = np.zeros((len(t), 2, 6))
    return with_forces(Tape(t, q, v, a, np.zeros((len(t), model.nv - 6)), phase, np.array(ROBOT.foot.frames), blank,
                            np.array(ROBOT.joint_names)))  # fmt: skip


def link_places(angles) -> list:
    """CoM (x, z) of the five links from the toe, at absolute link angles."""
    c, s = np.cos(angles), np.sin(angles)
    turn = np.array([[c, s], [-s, c]])  # (2, 2, angle)
    return [np.einsum("abj,jb->a", turn, arms) for arms in ROBOT.sagittal.com_arms()]


def test_statue_and_top(statue_and_top):
    task = JumpTask(1.0, 0.5, rotation_rad=-2 * math.pi)
    passport = audit(statue_and_top, ROBOT, task)
    for name in ("base force residual", "base moment residual", "joint torque consistency", "ballistic CoM",
                 "gravity in flight", "angular momentum in flight", "angular impulse", "mass", "toe slip",
                 "toe on the ground", "unit quaternion"):  # fmt: skip
        assert abs(passport[name].value) < 1e-6, name
    for name in ("linear impulse", "CoP in the sole", "friction used", "re-integrated positions", "rotation"):
        assert passport[name].passed, name
    for name in ("rate at the switch", "acceleration at the switch", "zero force at take-off", "free fall at take-off"):
        assert not passport[name].passed, name  # a statue cannot take off
    r = replay(statue_and_top, ROBOT, task)
    np.testing.assert_allclose(foot_turn(r), -2 * math.pi, atol=1e-9)
    angles = stance_angles(ROBOT)
    rho = ROBOT.sagittal.inertia.sum() + sum(  # pitch inertia about the CoM, from the five links
        m * np.sum((x - com_from_toe(ROBOT, angles)) ** 2)
        for m, x in zip(ROBOT.sagittal.mass, link_places(angles), strict=True)
    )
    assert r.momentum[-1, 1] / SPIN == pytest.approx(rho, rel=1e-9)
    assert r.mass == pytest.approx(42.0, abs=1e-9)


def test_pressure_point_of_a_known_force(statue_and_top):
    place, force = np.array([0.07, 0.11, 0.0]), np.array([30.0, -20.0, 400.0])
    ankle = replay(statue_and_top, ROBOT, None).foot[5, LEFT]
    moment = np.cross(place - ankle, force)
    wrench = [*force, moment[0], moment[1], moment[2] + 1.5]  # and 1.5 N m about the vertical
    tape = edit(statue_and_top, f=lambda f, i: f.__setitem__((5, LEFT), wrench))
    cop, torsion = contact._pressure_points(replay(tape, ROBOT, None))
    np.testing.assert_allclose(cop[5, LEFT], place[:2], atol=1e-12)
    assert torsion[5, LEFT] == pytest.approx(1.5, abs=1e-12)
    assert np.isnan(cop[400]).all()  # in the air


def test_torque_left_at_speed(statue_and_top):
    limits = ROBOT.actuators["left_knee"]
    peak, corner, top = limits["effort"], limits["corner_speed"], limits["speed"]
    half = (corner + top) / 2
    cases = [(0.0, 1, peak), (corner, 1, peak), (half, 1, peak / 2), (top, 1, 0.01 * peak), (half, -1, peak),
             (-half, -1, peak / 2), (2 * top, 1, 0.01 * peak)]  # fmt: skip
    v, tau = np.array(statue_and_top.v), np.array(statue_and_top.tau)
    for i, (speed, sign, _) in enumerate(cases):
        v[i, 6 + KNEE], tau[i, KNEE] = speed, sign
    left = available_torque(replay(dataclasses.replace(statue_and_top, v=v, tau=tau), ROBOT, None))
    np.testing.assert_allclose(left[: len(cases), KNEE], [c[2] for c in cases], rtol=1e-12)


def test_mirror_is_found_from_the_geometry(statue_and_top):
    model, _ = open_tape(statue_and_top, ROBOT, None)
    names = ROBOT.joint_names
    found = {names[left]: (names[right], sign) for left, right, sign in mirror(model)}
    assert found["left_hip_yaw"] == ("right_hip_yaw", -1.0)
    assert found["left_ankle_roll"] == ("right_ankle_roll", -1.0)
    assert found["right_knee"] == ("left_knee", 1.0)
    assert len(found) == len(names)
    lopsided = robot_with(urdf=('<origin xyz="0 0.23 0"', '<origin xyz="0 0.25 0"'))
    assert mirror(open_tape(statue_and_top, lopsided, None)[0]) is None
    assert not lopsided.planar  # no symmetric jump is defined for it
    assert "left/right posture" not in [check.name for check in audit(statue_and_top, lopsided).checks]


def test_step_between_two_surfaces(statue_and_top):
    r = replay(statue_and_top, ROBOT, JumpTask(1.0, 0.5, platform_m=0.3))
    heel, toe = r.sole_points[-1, ..., 0].min(), r.sole_points[0, ..., 0].max()
    assert r.heading == 1.0 and toe < heel - 0.05
    assert r.edge == pytest.approx(heel - 0.05)  # behind the landing sole
    np.testing.assert_allclose(r.surface([heel - 0.06, heel - 0.05, heel]), [0, 0.3, 0.3])
    down = dataclasses.replace(r, task=JumpTask(1.0, 0.5, platform_m=-0.2))
    np.testing.assert_allclose(down.surface([toe, toe + 0.049, toe + 0.051, heel]), [0, 0, -0.2, -0.2])
    given = replay(statue_and_top, ROBOT, JumpTask(1.0, 0.5, platform_m=0.3), edge_m=0.4)
    assert given.edge == pytest.approx(toe + 0.4)
    short = r.foot.copy()
    short[-1, :, 0] = r.foot[0, :, 0] + 0.26  # the soles now land 2 cm ahead of where they were
    near = dataclasses.replace(r, foot=short, foot_rotation=r.foot_rotation[[0] * len(short)])
    assert near.edge == pytest.approx(toe)


# ------------------------------------------------------------------------------------------------ report and folder


def test_report_is_strict_and_readable():
    rows = Limit("tape", "x", 9.0, "m", "what").worst([[1.0, np.nan], [5.0, 2.0]], [0.1, 0.2], ["a", "b"])
    assert math.isnan(rows.value) and not rows.passed and rows.time == 0.1 and rows.note.endswith("worst: b")
    low = Limit("tape", "low", 0.0, "m", "what", at_least=True).worst([3.0, -1.0], [0.1, 0.2])
    assert (low.value, low.time, low.passed) == (-1.0, 0.2, False)
    assert Limit("tape", "none", 2.0, "m", "what").worst([], []).passed
    passport = AuditReport((rows, low, Check("joints", "fine", 1, 2, "m", None, "ok")), {"size": np.float64(np.inf)})
    data = json.loads(passport.to_json(), parse_constant=pytest.fail)
    assert data["passed"] is False and data["failed"] == ["x", "low"] and data["manifest"]["size"] is None
    assert data["checks"][0]["value"] is None and data["checks"][2]["passed"] is True
    table = passport.table()
    assert "FAIL low" in table and "1 of 3 checks passed" in table and "FAIL x: what; worst: b" in table
    assert not AuditReport(()).passed
    with pytest.raises(KeyError):
        passport["absent"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        passport.checks = ()


def write_folder(path, tape: Tape, **summary):
    tape.save(path / "plan.npz")
    (path / "robot.urdf").write_text(ROBOT.urdf)
    (path / "robot.toml").write_text(ROBOT.config_text)
    (path / "summary.json").write_text(json.dumps(summary))


def test_folder_gets_its_passport(good, tmp_path):
    write_folder(tmp_path, good, target={"distance_m": 1.0, "height_m": 0.5, "other": 1}, stages=[{"iterations": 31}])
    passport = write_audit(tmp_path)
    data = json.loads((tmp_path / "passport.json").read_text())
    assert passport.passed and data["passed"] and len(data["checks"]) == len(passport.checks)
    assert data["manifest"]["target"]["distance_m"] == 1.0 and data["manifest"]["robot_hash"] == ROBOT.hash
    assert data["manifest"]["planner"]["stages"] == [{"iterations": 31}] and len(data["manifest"]["plan_sha256"]) == 64
    assert {"name", "value", "limit", "unit", "time", "passed", "note"} <= set(data["checks"][0])
    assert not write_audit(tmp_path, JumpTask(0.9, 0.5)).passed  # the caller's target wins
    assert not (set(p.name for p in tmp_path.iterdir()) - {"plan.npz", "robot.urdf", "robot.toml", "summary.json",
                                                           "passport.json"})  # fmt: skip


def test_interrupted_write_leaves_the_old_passport(good, tmp_path, monkeypatch):
    write_folder(tmp_path, good)
    write_audit(tmp_path)
    files = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_audit(tmp_path, JumpTask(0.9, 0.5))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == files


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("plan.npz", None, "no such plan"),
        ("plan.npz", "PK not a zip", "not a readable plan"),
        ("robot.urdf", None, "cannot be read"),
        ("robot.urdf", "<robot", "the URDF is no well-formed XML"),
        ("robot.toml", "name = ", "not a TOML file"),
        ("summary.json", "{", "not a readable JSON file"),
        ("summary.json", "[]", "not a JSON object"),
        ("summary.json", '{"target": {"distance_m": 99, "height_m": 0.5}}', "distance = 99 m is outside"),
    ],
)
def test_damaged_folder_is_refused_in_one_sentence(good, tmp_path, name, content, message):
    write_folder(tmp_path, good)
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises((InputError, RobotError), match=message) as error:
        write_audit(tmp_path)
    assert "\n" not in str(error.value) and not (tmp_path / "passport.json").exists()
