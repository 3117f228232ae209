"""The audit: clean on a good plan, and every check fails on a tape (or robot, or target) broken in just that way."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pinocchio as pin
import pytest
from fixtures_audit import (
    FLYING,
    HIP,
    KNEE,
    LAST,
    LEFT,
    PUSHING,
    ROBOT,
    STANDING,
    TASK,
    drop_row,
    edit,
    everywhere,
    joint,
    moved_cop,
    put,
    robot_with,
    shifted,
    strong_at_speed,
)
from fixtures_core import jump

from jumplab.auditing import AuditReport, audit
from jumplab.task import JumpTask


def pulling(f, takeoff):
    f[takeoff - 10, LEFT, 2] = -5.0


def sideways_grip(f, takeoff):
    f[STANDING, :, 1] += np.array([0.6, -0.6]) * f[STANDING, :, 2]


def on_flat_feet(f, takeoff):
    """A moment that moves the CoP by millimetres, inside the sole."""
    f[: takeoff - 150, :, 4] += 0.5


def twist(f, takeoff):
    f[STANDING, :, 5] += np.array([0.03, -0.03]) * f[STANDING, :, 2]


def falling_faster(q, takeoff):
    """Flight under 9.815 m/s^2 instead of 9.8."""
    since = np.arange(len(q) - takeoff) / 1000.0
    q[takeoff:, 2] -= 0.015 / 2 * since**2


def tilted_touchdown(q, takeoff):
    q[-1, 7 + joint("left_ankle_pitch")] += 0.05


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
    "angular impulse": lambda t: edit(t, f=on_flat_feet),
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
    "foot turn": lambda t: edit(t, q=put(STANDING, 7 + joint("left_hip_yaw"), 0.04)),
    "toe on the ground": lambda t: shifted(t, 2, 0.002, 0.1, 0.8 * t.takeoff_time),
    "penetration": lambda t: shifted(t, 2, -0.002, 0.1, 0.8 * t.takeoff_time),
    "foot clearance": lambda t: shifted(t, 2, -0.45, t.takeoff_time + 0.01, t.t[-1] - 0.01),
    "CoP in the sole": lambda t: moved_cop(t, STANDING, 0.3),
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


def audited(broken) -> AuditReport:
    return audit(*broken) if isinstance(broken, tuple) else audit(broken, ROBOT, TASK)


# --------------------------------------------------------------------------------------------- good and broken tapes


def test_good_plan_is_clean(good):
    """Every check has a corruption below; it says value, limit and unit, and the worst instant where there is one."""
    before = {k: v.copy() for k, v in good.arrays().items()}
    passport = audit(good, ROBOT, TASK)
    assert passport.passed, passport.table()
    assert sorted(BROKEN) == sorted(c.name for c in passport.checks)
    assert all(
        math.isfinite(c.value) and math.isfinite(c.limit) and c.unit and len(c.note) > 15 for c in passport.checks
    )
    timeless = {"finite numbers", "order of phases", "gravity in flight", "mass", "sole as in the URDF",
                "links have mass"}  # fmt: skip
    assert {c.name for c in passport.checks if c.time is None} == timeless
    assert all(0 <= c.time <= good.t[-1] for c in passport.checks if c.time is not None)
    assert audit(good, ROBOT, TASK).to_json() == passport.to_json()
    for name, array in good.arrays().items():
        np.testing.assert_array_equal(array, before[name])


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


@pytest.mark.parametrize(
    "target", [(0.6, 0.5, 0.3), (0.6, 0.5, -0.2), (1.0, 0.5, 0.0, "direct"), (0.3, 0.2, 0.0, "direct"), (0.0, 0.1)]
)
def test_other_good_plans_are_clean(target):
    """Onto and off a platform; the direct planner; and small hops, whose feet pass closest to the ground."""
    passport = audit(jump(*target).tape, ROBOT, JumpTask(*target[:3]))
    assert passport.passed, passport.table()


def test_without_a_task_the_target_is_left_out(good):
    passport = audit(good, ROBOT)
    names = {c.name for c in passport.checks}
    assert passport.passed and not names & {"distance", "rise", "rotation", "start at rest"}
    assert "sole on the surface" in names and passport.manifest["target"] is None


def test_audit_shares_no_code_with_the_planner():
    code = """
import sys, jumplab.auditing
ours = {"errors", "arguments", "reading", "task", "robot", "io", "auditing"}
names = [m.split(".") for m in sys.modules]
print([n for n in names if n[0] == "casadi" or n[0] == "jumplab" and len(n) > 1 and n[1] not in ours])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr
