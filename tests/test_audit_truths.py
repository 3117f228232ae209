"""The audit's own quantities against closed forms that no planner made."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_audit import ROBOT, with_forces

from jumplab.auditing import audit
from jumplab.auditing.motion import capture, foot_turn
from jumplab.auditing.replay import replay
from jumplab.io.tape import Tape
from jumplab.robot.stance import com_from_toe, stance_angles, stance_configuration
from jumplab.task import JumpTask

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


@pytest.mark.parametrize(
    ("velocity", "spin", "rests"),
    [
        ((0.0, 0.0, -3.0), 0.0, 0.1 * 3.0 / 0.5),  # ahead of the soles' middle, so the impact throws it forward
        ((0.6, 0.0, 0.0), 0.0, 0.6),
        ((0.6, 0.0, 0.0), -40 * 0.6 * 0.5, 0.0),  # the angular momentum takes it back
        ((-1.0, 0.0, 0.0), 0.0, -1.0),
    ],
)
def test_the_capture_point_by_hand(velocity, spin, rests):
    """A CoM 0.5 m over soles of 0.2 m and 0.1 m ahead of their middle, gravity 9.8, 40 kg."""
    corners = np.array([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    r = SimpleNamespace(is_jump=True, sole_points=corners[None, None], com=np.array([[0.1, 0.0, 0.5]]), mass=40.0,
                        momentum=np.array([[0.0, spin, 0.0]]), com_velocity=np.array([velocity]), gravity=9.8,
                        tape=SimpleNamespace(t=np.array([1.0])))  # fmt: skip
    ((name, share, when),) = capture(r)
    place = 0.1 + rests * math.sqrt(0.5 / 9.8)
    assert (name, when.tolist()) == ("capture point", [1.0])
    assert share == pytest.approx(max(0.0, abs(place) - 0.1) / 0.5)
    r.is_jump = False
    assert list(capture(r)) == []


def test_a_jump_that_lands_can_be_caught(good):
    assert audit(good, ROBOT, JumpTask(1.0, 0.5)).sound


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
