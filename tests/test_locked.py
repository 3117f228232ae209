"""Joints of a published robot that no jump moves: what holds them, in the model, in plans and in the audit."""

import casadi as ca
import fixtures_robots as robots
import numpy as np
import pinocchio as pin
import pytest

import jumplab as jl
from jumplab.auditing.audit import audit
from jumplab.errors import RobotError
from jumplab.io.motion import Motion
from jumplab.io.whole import Whole
from jumplab.models.spatial import SpatialModel, SpatialState
from jumplab.robot import Robot
from jumplab.robot.locked import LockedJoint
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.coordinates import even

TASK = jl.JumpTask(0.4, 0.2)
CHECK = "torque of locked joints"


def loaded(tmp_path, variant, *args) -> Robot:
    return Robot.load(robots.write(tmp_path, variant, *args))


def held(robot: Robot, q, v, a) -> dict[str, float]:
    """Torques of the published robot's joints in a state of the one that jumps, by Pinocchio [N m]."""
    whole = Whole(robot)
    still = np.zeros(robot.model.nv - 6)
    one = Motion(np.zeros(1), q[None], v[None], still[None], np.array(["launch"]), "plan")
    state, rates = (x[0] for x in whole.states(whole.frames(one, 1000.0)))
    root = pin.XYZQUATToSE3(q[:7]).actInv(pin.XYZQUATToSE3(state[:7]))
    own = dict(zip(robot.joint_names, a[6:], strict=True))
    gain = [*root.actInv(pin.Motion(a[:6])).vector, *(own.get(name, 0.0) for name in whole.model.names[2:])]
    model = whole.model
    data = model.createData()
    motion = state, rates, np.array(gain)
    # the ground's forces reach all else through the body that carries the legs
    need = pin.Force(pin.rnea(model, data, *motion)[:6])
    trunk = model.frames[model.getFrameId("pelvis" if model.existBodyName("pelvis") else "trunk")].parentJoint
    push = [pin.Force.Zero() for _ in range(model.njoints)]
    push[trunk] = data.oMi[trunk].actInv(data.oMi[1].act(need))
    return dict(zip(model.names[2:], pin.rnea(model, data, *motion, push)[6:], strict=True))


@pytest.mark.parametrize("variant, args", [(robots.torso, ()), (robots.waist, (4.0,))])
def test_they_hold_what_the_published_robot_needs(tmp_path, variant, args):
    """The tree of the program against Pinocchio on all joints: waists above the legs and below the root."""
    robot = loaded(tmp_path, variant, *args)
    model = SpatialModel(robot.model)
    q, v, a = (ca.SX.sym(x, len(model.names)) for x in "qva")
    state = SpatialState(model, q, v, a)
    told = ca.Function("told", [q, v, a], [state.locked_torque(x) for x in robot.locked])
    rng = np.random.default_rng(4)
    assert robot.locked
    for _ in range(4):
        motion = rng.normal(size=(3, len(model.names)))
        found = [float(x) for x in told.call([*motion])]
        needed = held(robot, *(x[0] for x in model.to_pinocchio(*motion[:, None])))
        assert found == pytest.approx([needed[x.name] for x in robot.locked], abs=1e-6)
        assert max(map(abs, found)) > 0.1


def test_the_left_half_of_an_even_motion_tells_the_same():
    """A waist holds both arms, a held collar bone its own; by hand on the default robot."""
    body = Body(Robot.load())
    free = even(body)
    arms = tuple(x for x in body.joint_names if "shoulder" in x)
    part = pin.Inertia(2.0, np.array([0.02, 0.0, 0.1]), np.diag([0.02, 0.01, 0.02]))
    waist = LockedJoint("waist", 1.0, np.array([0.0, 0.0, 0.05]), np.array([0.0, 1.0, 0.0]), part, arms)
    collar = LockedJoint("collar", 1.0, np.array([0.0, 0.1, 0.3]), np.array([0.6, 0.8, 0.0]), part, arms[:1])
    q, v, a = (ca.SX.sym(x, len(body.model.names)) for x in "qva")
    both = [SpatialState(body.model, q, v, a, even=half) for half in (False, True)]
    told = ca.Function("told", [q, v, a], [x.locked_torque(k) for k in (waist, collar) for x in both])
    rng = np.random.default_rng(5)
    motion = [free.charts(rng.normal(size=(1, free.size)), level)[0] for level in range(3)]
    whole_waist, even_waist, whole_collar, even_collar = (float(x) for x in told.call(motion))
    assert (even_waist, even_collar) == pytest.approx((whole_waist, whole_collar), abs=1e-9)
    assert min(abs(whole_waist), abs(whole_collar)) > 0.1


def test_parts_that_weigh_little_are_no_load(tmp_path):
    """A chest of 4 kg of 46 is one, of 2 kg of 44 none; a robot without [published] has none."""
    assert [x.name for x in loaded(tmp_path, robots.waist, 4.0).locked] == ["waist"]
    assert loaded(tmp_path, robots.waist, 2.0).locked == ()
    assert Robot.load().locked == ()


def test_a_changed_trunk_is_a_changed_load(tmp_path):
    robot = loaded(tmp_path, robots.torso)
    heavier = robot.with_mass("pelvis", factor=1.5)
    assert heavier.locked[0].part.mass == pytest.approx(1.5 * robot.locked[0].part.mass)


def test_a_weaker_robot_has_a_weaker_waist(tmp_path):
    """Factors on all motors count for held ones; each can be changed by its name, but only its effort."""
    robot = loaded(tmp_path, robots.torso)
    efforts = {
        50.0: robot.with_limits(effort=0.5),
        150.0: robot.with_limits(effort={"waist": 1.5}),
        35.0: robot.with_limits(joints={"waist": {"effort": 35.0}}),
        100.0: robot.with_limits(speed=0.9, effort={"knee": 1.1}),
    }
    for effort, other in efforts.items():
        assert other.locked[0].effort == effort and other.hash != robot.hash
    assert robot.with_limits(effort=1.0) is robot
    assert efforts[150.0].actuators == robot.actuators
    assert "# changed: effort of joint 'waist', 100 -> 50 N m" in efforts[50.0].config_text
    with pytest.raises(RobotError, match="the speed of joint 'waist' cannot change: it is held, so only its effort"):
        robot.with_limits(joints={"waist": {"speed": 3.0}})


def test_plans_keep_within_a_weak_waist(tmp_path):
    """A plan for a strong waist fails the audit of a weak one, at the joint and by the torque that Pinocchio finds;
    a plan for the weak one passes."""
    strong = loaded(tmp_path, robots.torso)
    plan = jl.plan(TASK, strong)
    (check,) = (x for x in plan.audit.checks if x.name == CHECK)
    needed = [abs(held(strong, *row)["waist"]) for row in zip(plan.tape.q, plan.tape.v, plan.tape.a, strict=True)]
    assert check.value == pytest.approx(max(needed), rel=1e-6)  # of 100 N m
    assert check.passed and "waist" in check.note
    weak = loaded(tmp_path, robots.torso, 0.7 * max(needed))
    (check,) = (x for x in audit(plan.tape, weak, TASK).checks if x.name == CHECK)
    assert check.value == pytest.approx(100 / 0.7, rel=1e-6) and not check.passed
    again = jl.plan(TASK, weak)
    (check,) = (x for x in again.audit.checks if x.name == CHECK)
    assert check.passed and again.audit.passed
