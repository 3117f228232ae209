"""The audit: clean on a good plan, and every check fails on a tape (or robot, or target) broken in just that way."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest

from jumplab.errors import InputError, RobotError
from jumplab.passport import Check, Passport, audit, contact, folder, write_passport
from jumplab.passport.joints import available_torque
from jumplab.passport.kinematics import mirror
from jumplab.passport.replay import open_tape, replay
from jumplab.passport.report import worst
from jumplab.passport.target import foot_turn
from jumplab.pipeline import plan_jump
from jumplab.robot import Robot, load_robot
from jumplab.robot.stance import com_from_toe, stance_angles, stance_configuration
from jumplab.task import JumpTask
from jumplab.trajectory import Tape

TASK = JumpTask(1.0, 0.5)
ROBOT = load_robot()
LEFT, RIGHT = 0, 1
STANDING = 100  # row early in the launch, the foot flat
FLYING, LAST, PUSHING = "flight", -1, -30  # rows from take-off: 100 later, the last of the launch, heel up


def joint(name: str) -> int:
    """Index of a joint among the columns of tau; add 6 for v and 7 for q."""
    return ROBOT.joint_names.index(name)


KNEE, HIP = joint("left_knee"), joint("left_hip_pitch")


@pytest.fixture(scope="session")
def good() -> Tape:
    return plan_jump(TASK, ROBOT, method="direct").tape


# ------------------------------------------------------------------------------------------- tools to break a tape


def edit(tape: Tape, **changes) -> Tape:
    """Copy of a tape on which each function has changed its array in place."""
    arrays = {name: np.array(getattr(tape, name)) for name in changes}
    for name, change in changes.items():
        change(arrays[name], tape.takeoff_index)
    return dataclasses.replace(tape, **arrays)


def row_of(row, takeoff: int) -> int:
    """Row index; negative ones are counted back from take-off."""
    return takeoff + 100 if row == FLYING else row + takeoff if row < 0 else row


def put(row, column, amount, *, relative=True):
    """Change that adds ``amount`` to (or sets) one entry."""

    def change(x, takeoff):
        at = (row_of(row, takeoff), *np.atleast_1d(column))
        x[at] = amount + (x[at] if relative else 0.0)

    return change


def everywhere(column, amount, phase: str | None = None):
    """Change that adds ``amount`` to a column over a phase or the whole tape."""

    def change(x, takeoff):
        rows = {"launch": slice(takeoff), "flight": slice(takeoff, None), None: slice(None)}[phase]
        x[(rows, *np.atleast_1d(column))] += amount

    return change


def bump(t, first, last):
    """Smooth bump (n,) from 0 to 1 and back between two times, and its two derivatives."""
    s = (t - first) / (last - first)
    inside = (s > 0) & (s < 1)
    p = np.poly1d([-64, 192, -192, 64, 0, 0, 0])  # 64 s^3 (1 - s)^3
    rows = [np.where(inside, p.deriv(k)(s) if k else p(s), 0.0) / (last - first) ** k for k in range(3)]
    return rows


def shifted(tape: Tape, axis: int, amount: float, first: float, last: float) -> Tape:
    """The whole robot shifted along a world axis by a smooth bump, with consistent q, v, a and honest forces."""
    s, rate, acceleration = (amount * x for x in bump(tape.t, first, last))
    q, v, a = np.array(tape.q), np.array(tape.v), np.array(tape.a)
    q[:, axis] += s
    turn = np.array([pin.Quaternion(x).matrix() for x in tape.q[:, 3:7]])  # base to world
    v[:, :3] += turn[:, axis] * rate[:, None]
    drag = np.cross(v[:, 3:6], turn[:, axis] * rate[:, None])
    a[:, :3] += turn[:, axis] * acceleration[:, None] - drag
    return with_forces(dataclasses.replace(tape, q=q, v=v, a=a))


def with_forces(tape: Tape, robot: Robot = ROBOT) -> Tape:
    """Wrenches (half to each foot) and torques that the motion needs; in flight torques only."""
    model = robot.model
    data, feet = model.createData(), [model.getFrameId(str(n)) for n in tape.contact_frames]
    f, tau = np.zeros_like(tape.f), np.zeros_like(tape.tau)
    for i in range(len(tape.t)):
        q = tape.q[i]
        need = pin.rnea(model, data, q, tape.v[i], tape.a[i])
        pin.framesForwardKinematics(model, data, q)
        tau[i] = need[6:]
        if tape.phase[i] == "flight":
            continue
        total = data.oMi[1].act(pin.Force(need[:6]))  # about the world's origin
        middle = np.mean([data.oMf[frame].translation for frame in feet], axis=0)
        moment = total.angular - np.cross(middle, total.linear)  # about the middle between the feet
        for k, frame in enumerate(feet):
            f[i, k] = np.concatenate([total.linear, moment]) / 2
            jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
            tau[i] -= (jacobian.T @ f[i, k])[6:]
    return dataclasses.replace(tape, f=f, tau=tau)


def drop_row(tape: Tape, row: int) -> Tape:
    names = ("t", "q", "v", "a", "tau", "phase", "f")
    return dataclasses.replace(tape, **{n: np.delete(getattr(tape, n), row, axis=0) for n in names})


def moved_cop(tape: Tape, row: int, metres: float) -> Tape:
    """Centre of pressure of the left foot moved forward in one row, by its pitch moment."""

    def change(f, takeoff):
        i = row_of(row, takeoff)
        f[i, LEFT, 4] -= metres * f[i, LEFT, 2]

    return edit(tape, f=change)


def pulling(f, takeoff):
    f[takeoff - 10, LEFT, 2] = -5.0


def sideways_grip(f, takeoff):
    f[STANDING, :, 1] += np.array([0.6, -0.6]) * f[STANDING, :, 2]


def twist(f, takeoff):
    f[STANDING, :, 5] += np.array([0.03, -0.03]) * f[STANDING, :, 2]


def strong_at_speed(tape: Tape) -> Tape:
    """Nearly full torque, allowed at low speed, in the joint and the sample nearest to the speed limit."""
    limits = [ROBOT.actuators[n] for n in ROBOT.joint_names]
    speed = tape.v[:, 6:] / [x["speed"] for x in limits]
    i, j = np.unravel_index(np.argmax(np.abs(speed)), speed.shape)
    assert limits[j]["corner_speed"] / limits[j]["speed"] < abs(speed[i, j]) < 1
    return edit(tape, tau=put(int(i), j, math.copysign(0.99 * limits[j]["effort"], speed[i, j]), relative=False))


def falling_faster(q, takeoff):
    """Flight under 9.815 m/s^2 instead of 9.8."""
    since = np.arange(len(q) - takeoff) / 1000.0
    q[takeoff:, 2] -= 0.015 / 2 * since**2


def tilted_touchdown(q, takeoff):
    q[-1, 7 + joint("left_ankle_pitch")] += 0.05


def robot_with(urdf=(), config=()) -> Robot:
    """The default robot with replacements in its files; each old text must be there."""
    texts = [ROBOT.urdf, ROBOT.config_text]
    for which, pair in ((0, urdf), (1, config)):
        if pair:
            assert pair[0] in texts[which]
            texts[which] = texts[which].replace(*pair)
    return Robot.from_text(*texts)


HEAVIER = ('<mass value="19.994" />', '<mass value="20.994" />')
DUMMY_INERTIAL = """  <link name="left_ankle_link">
    <inertial>
      <origin xyz="0 0 0" rpy="0 0 0" />
      <mass value="0.001" />
      <inertia ixx="1e-06" ixy="0" ixz="0" iyy="1e-06" iyz="0" izz="1e-06" />
    </inertial>
  </link>
"""

# check -> function of the good tape that returns what to audit: a tape, or (tape, robot, task)
BROKEN = {
    "finite numbers": lambda t: edit(t, q=put(5, 8, np.nan, relative=False)),
    "order of phases": lambda t: edit(t, phase=lambda x, i: x.__setitem__(10, "flight")),
    "time step": lambda t: drop_row(t, 400),
    "unit quaternion": lambda t: edit(t, q=lambda x, i: x[400].__setitem__(slice(3, 7), x[400, 3:7] * 1.00001)),
    "rates against positions": lambda t: edit(t, v=put(STANDING, 6 + KNEE, 0.05)),
    "accelerations against rates": lambda t: edit(t, a=put(STANDING, 6 + KNEE, 20.0)),
    "re-integrated positions": lambda t: edit(t, v=everywhere(6 + KNEE, 0.005)),
    "re-integrated rates": lambda t: edit(t, a=everywhere(6 + KNEE, 0.05)),
    "position at the switch": lambda t: edit(t, q=everywhere(0, 0.0005, "flight")),
    "rate at the switch": lambda t: edit(t, v=everywhere(6 + KNEE, 0.02, "flight")),
    "acceleration at the switch": lambda t: edit(t, a=everywhere(6 + KNEE, 1.5, "flight")),
    "left/right posture": lambda t: edit(t, q=everywhere(7 + KNEE, 0.001)),
    "left/right effort": lambda t: edit(t, f=everywhere([LEFT, 2], 1.0, "launch")),
    "base force residual": lambda t: edit(t, f=put(STANDING, [LEFT, 0], 5.0)),
    "base moment residual": lambda t: edit(t, f=put(STANDING, [LEFT, 4], 5.0)),
    "joint torque consistency": lambda t: edit(t, tau=put(STANDING, KNEE, 5.0)),
    "linear impulse": lambda t: edit(t, f=everywhere([slice(None), 0], 0.75, "launch")),
    "angular impulse": lambda t: edit(t, f=everywhere([slice(None), 4], 0.5, "launch")),
    "ballistic CoM": lambda t: shifted(t, 0, 0.003, t.takeoff_time + 0.1, t.t[-1] - 0.1),
    "gravity in flight": lambda t: edit(t, q=falling_faster),
    "angular momentum in flight": lambda t: edit(t, v=everywhere(6 + joint("left_shoulder_pitch"), 0.2, "flight")),
    "no force in flight": lambda t: edit(t, f=put(FLYING, [LEFT, 2], 5.0)),
    "zero force at take-off": lambda t: edit(t, f=put(LAST, [slice(None), 2], 2.0)),
    "zero moment at take-off": lambda t: edit(t, f=put(LAST, [slice(None), 4], 2.0)),
    "free fall at take-off": lambda t: edit(t, a=put(LAST, 0, 0.2)),
    "energy balance": lambda t: edit(t, tau=lambda x, i: x.__imul__(1.02)),
    "mass": lambda t: (t, robot_with(urdf=HEAVIER), TASK),
    "toe slip": lambda t: shifted(t, 0, 0.003, 0.1, 0.8 * t.takeoff_time),
    "toe on the ground": lambda t: shifted(t, 2, 0.002, 0.1, 0.8 * t.takeoff_time),
    "penetration": lambda t: shifted(t, 2, -0.002, 0.1, 0.8 * t.takeoff_time),
    "foot clearance": lambda t: shifted(t, 2, -0.3, t.takeoff_time + 0.01, t.t[-1] - 0.01),
    "CoP in the sole": lambda t: moved_cop(t, STANDING, 0.15),
    "CoP at the toe": lambda t: moved_cop(t, PUSHING, -0.02),
    "torsional friction": lambda t: edit(t, f=twist),
    "friction used": lambda t: edit(t, f=sideways_grip),
    "ground only pushes": lambda t: edit(t, f=pulling),
    "joint range": lambda t: edit(t, q=put(STANDING, 7 + KNEE, -0.02, relative=False)),
    "joint speed": lambda t: edit(t, v=put(STANDING, 6 + KNEE, -20.5, relative=False)),
    "joint torque": lambda t: edit(t, tau=put(STANDING, KNEE, 215.0, relative=False)),
    "torque at speed": strong_at_speed,
    "sole on the surface": lambda t: edit(t, q=lambda x, i: x[-1].__setitem__(2, x[-1, 2] + 0.003)),
    "sole flat at touchdown": lambda t: edit(t, q=tilted_touchdown),
    "start at rest": lambda t: edit(t, v=put(0, 6 + KNEE, 0.05)),
    "distance": lambda t: (t, ROBOT, JumpTask(1.01, 0.5)),
    "rise": lambda t: (t, ROBOT, JumpTask(1.0, 0.51)),
    "rotation": lambda t: (t, ROBOT, JumpTask(1.0, 0.5, rotation_rad=-2 * math.pi)),
    "self-collision": lambda t: edit(t, q=put(STANDING, 7 + HIP, -2.3, relative=False)),
    "body clearance": lambda t: edit(t, q=put(STANDING, 2, -0.12)),
    "sole as in the URDF": lambda t: (t, robot_with(config=("[-0.10, 0.14]", "[-0.10, 0.16]")), TASK),
    "links have mass": lambda t: (t, robot_with(urdf=(DUMMY_INERTIAL, '  <link name="left_ankle_link" />\n')), TASK),
}  # fmt: skip


# corruptions that nothing else can notice
ALONE = {"finite numbers", "order of phases", "time step", "unit quaternion", "re-integrated positions",
         "position at the switch", "angular impulse", "toe slip", "toe on the ground", "distance", "rise", "rotation",
         "sole as in the URDF", "links have mass"}  # fmt: skip


def audited(broken) -> Passport:
    return audit(*broken) if isinstance(broken, tuple) else audit(broken, ROBOT, TASK)


# --------------------------------------------------------------------------------------------- good and broken tapes


def test_good_plan_is_clean(good):
    passport = audit(good, ROBOT, TASK)
    assert passport.passed, passport.table()
    assert len({c.name for c in passport.checks}) == len(passport.checks)


def test_every_check_has_its_corruption(good):
    assert set(BROKEN) == {c.name for c in audit(good, ROBOT, TASK).checks}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_in_just_that_way(good, name):
    passport = audited(BROKEN[name](good))
    failed = {c.name for c in passport.failed}
    assert name in failed, passport.table()
    assert failed == {name} or name not in ALONE
    assert len(failed) < len(BROKEN) / 2  # the verdict points somewhere


def test_wrong_conventions_are_caught(good):
    heavier_gravity = audit(good, ROBOT, dataclasses.replace(TASK, gravity=9.81))
    assert {"ballistic CoM", "gravity in flight"} <= {c.name for c in heavier_gravity.failed}

    turn = np.array([pin.Quaternion(x).matrix() for x in good.q[:, 3:7]])
    world = edit(good, v=lambda v, i: v.__setitem__((slice(None), slice(3)), np.einsum("nij,nj->ni", turn, v[:, :3])))
    assert not audit(world, ROBOT, TASK)["rates against positions"].passed

    local = np.zeros_like(good.f)
    local[..., :3] = good.f[..., :3]  # moments forgotten
    assert not audit(dataclasses.replace(good, f=local), ROBOT, TASK)["base moment residual"].passed


def test_landing_on_a_platform_that_is_not_there(good):
    passport = audit(good, ROBOT, JumpTask(1.0, 0.5, platform_m=0.3))
    assert passport["sole on the surface"].value == pytest.approx(300, abs=1)
    assert passport["penetration"].value == pytest.approx(300, abs=1)
    assert {"sole on the surface", "penetration", "body clearance"} <= {c.name for c in passport.failed}


@pytest.mark.parametrize("platform", [0.3, -0.2])
def test_platform_plan_is_clean(platform):
    task = JumpTask(0.6, 0.5, platform_m=platform)
    passport = audit(plan_jump(task, ROBOT, method="direct").tape, ROBOT, task)
    assert passport.passed, passport.table()


def test_audit_is_repeatable_and_leaves_the_tape_alone(good):
    before = {k: v.copy() for k, v in good.arrays().items()}
    assert audit(good, ROBOT, TASK).to_json() == audit(good, ROBOT, TASK).to_json()
    for name, array in good.arrays().items():
        np.testing.assert_array_equal(array, before[name])


def test_without_a_task_the_target_is_left_out(good):
    passport = audit(good, ROBOT)
    names = {c.name for c in passport.checks}
    assert passport.passed and not names & {"distance", "rise", "rotation", "start at rest"}
    assert "sole on the surface" in names and passport.manifest["target"] is None


def test_another_robots_tape_is_refused(good):
    other = robot_with(urdf=("left_knee", "left_other"), config=("left_knee", "left_other"))
    with pytest.raises(InputError, match="joints are not those of the robot 'bhr'"):
        audit(good, other, TASK)
    with pytest.raises(InputError, match=r"q has shape \(\d+, 20\), the robot 'bhr' needs"):
        audit(dataclasses.replace(good, q=good.q[:, :-1]), ROBOT, TASK)
    with pytest.raises(InputError, match="'tail' is not a link"):
        audit(dataclasses.replace(good, contact_frames=np.array(["left_foot", "tail"])), ROBOT, TASK)


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
    assert not audit(statue_and_top, lopsided)["left/right posture"].passed


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
    rows = worst("tape", "x", [[1.0, np.nan], [5.0, 2.0]], [0.1, 0.2], 9.0, "m", "what", labels=["a", "b"])
    assert math.isnan(rows.value) and not rows.passed and rows.time == 0.1 and rows.note.endswith("worst: b")
    low = worst("tape", "low", [3.0, -1.0], [0.1, 0.2], 0.0, "m", "what", at_least=True)
    assert (low.value, low.time, low.passed) == (-1.0, 0.2, False)
    assert worst("tape", "none", [], [], 2.0, "m", "what").passed
    passport = Passport((rows, low, Check("joints", "fine", 1, 2, "m", None, "ok")), {"size": np.float64(np.inf)})
    data = json.loads(passport.to_json(), parse_constant=pytest.fail)
    assert data["passed"] is False and data["failed"] == ["x", "low"] and data["manifest"]["size"] is None
    assert data["checks"][0]["value"] is None and data["checks"][2]["passed"] is True
    table = passport.table()
    assert "FAIL low" in table and "1 of 3 checks passed" in table and "FAIL x: what; worst: b" in table
    assert not Passport(()).passed
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
    passport = write_passport(tmp_path)
    data = json.loads((tmp_path / "passport.json").read_text())
    assert passport.passed and data["passed"] and len(data["checks"]) == len(passport.checks)
    assert data["manifest"]["target"]["distance_m"] == 1.0 and data["manifest"]["robot_hash"] == ROBOT.hash
    assert data["manifest"]["planner"]["stages"] == [{"iterations": 31}] and len(data["manifest"]["plan_sha256"]) == 64
    assert {"name", "value", "limit", "unit", "time", "passed", "note"} <= set(data["checks"][0])
    assert not write_passport(tmp_path, JumpTask(0.9, 0.5)).passed  # the caller's target wins
    assert not (set(p.name for p in tmp_path.iterdir()) - {"plan.npz", "robot.urdf", "robot.toml", "summary.json",
                                                           "passport.json"})  # fmt: skip


def test_interrupted_write_leaves_the_old_passport(good, tmp_path, monkeypatch):
    write_folder(tmp_path, good)
    write_passport(tmp_path)
    files = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(folder.os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_passport(tmp_path, JumpTask(0.9, 0.5))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == files


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("plan.npz", None, "no such plan"),
        ("plan.npz", "PK not a zip", "not a readable plan"),
        ("robot.urdf", None, "cannot be read"),
        ("robot.urdf", "<robot", "Pinocchio cannot read the URDF"),
        ("robot.toml", "name = ", "not a TOML file"),
        ("summary.json", "{", "not a JSON file"),
        ("summary.json", "[]", "must hold a JSON object"),
        ("summary.json", '{"target": {"distance_m": 99, "height_m": 0.5}}', "distance = 99 m is outside"),
    ],
)
def test_damaged_folder_is_refused_in_one_sentence(good, tmp_path, name, content, message):
    write_folder(tmp_path, good)
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises((InputError, RobotError), match=message) as error:
        write_passport(tmp_path)
    assert "\n" not in str(error.value) and not (tmp_path / "passport.json").exists()


def test_audit_shares_no_code_with_the_planner():
    code = """
import sys, jumplab.passport
ours = {"errors", "task", "trajectory", "robot", "passport"}
names = [m.split(".") for m in sys.modules]
print([n for n in names if n[0] == "casadi" or n[0] == "jumplab" and len(n) > 1 and n[1] not in ours])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr
