"""The model of any tree in space against Pinocchio: dynamics, momentum, places, and the chart of the base."""

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from jumplab.errors import RobotError
from jumplab.models.spatial import SpatialModel, SpatialState, rates
from jumplab.robot import Robot

EXACT = 1e-9


def canted() -> pin.Model:
    """A tree with branches, tilted axes of both signs, armature, and a base off its joint."""
    rng, model = np.random.default_rng(3), pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    chain = [joint]
    for k in range(9):
        axis = rng.normal(size=3) if k % 3 else -np.eye(3)[k // 3]
        parent = chain[rng.integers(len(chain))]
        place = pin.SE3(pin.rpy.rpyToMatrix(rng.normal(size=3)), rng.normal(size=3))
        kind = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        joint = model.addJoint(parent, kind, place, f"joint {k}")
        model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
        chain.append(joint)
    model.armature[6:] = rng.uniform(0, 0.1, 9)
    model.name, model.gravity.linear = "canted", np.array([0.0, 0.0, -9.8])
    return model


def model_of(name: str) -> pin.Model:
    if name == "canted":
        return canted()
    try:
        return Robot.load(name).model
    except RobotError as e:
        pytest.skip(str(e))


def states(n: int, count: int = 5):
    """Charts, rates and accelerations with several full turns of yaw and pitch."""
    rng = np.random.default_rng(0)
    q, v, a = rng.normal(size=(count, n)), 3 * rng.normal(size=(count, n)), 20 * rng.normal(size=(count, n))
    q[:, [3, 5]] *= 6
    q[:, 4] = rng.uniform(-1.4, 1.4, count)
    return q, v, a


@pytest.mark.parametrize("name", ["bhr", "g1", "canted"])
def test_dynamics_and_momentum_are_pinocchios(name):
    tree = model_of(name)
    model, data = SpatialModel(tree), tree.createData()
    n, tip = len(model.names), np.array([0.1, 0.2, 0.3])
    q, v, a = (ca.SX.sym(k, n) for k in "qva")
    s, last = SpatialState(model, q, v, a), model.joints
    seen = [*s.dynamics(), s.com, s.com_velocity, s.angular_momentum, s.rotation(last), s.spin(last)]
    local = model.local(last + 1, tip)
    told = ca.Function("told", [q, v, a], [*seen, s.point(last, local), s.point_velocity(last, local)])
    charts = states(n)
    for chart, motion in zip(zip(*charts, strict=True), zip(*model.to_pinocchio(*charts), strict=True), strict=True):
        force, moment, torque, com, speed, momentum, turn, spin, place, rate = (
            x.full().squeeze() for x in told(*chart)
        )
        need = pin.rnea(tree, data, *motion)
        pin.computeCentroidalMomentum(tree, data, *motion[:2])
        pin.forwardKinematics(tree, data, *motion[:2])
        base, end, axes = data.oMi[1].rotation, data.oMi[last + 1], pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        twist = pin.getVelocity(tree, data, last + 1, axes)
        assert force == pytest.approx(base @ need[:3], abs=EXACT)
        assert moment == pytest.approx(base @ need[3:6], abs=EXACT)
        assert torque == pytest.approx(need[6:], abs=EXACT)
        assert com == pytest.approx(pin.centerOfMass(tree, data, motion[0]), abs=EXACT)
        assert speed * model.mass == pytest.approx(data.hg.linear, abs=EXACT)
        assert momentum == pytest.approx(data.hg.angular, abs=EXACT)
        assert turn @ model.bodies[last].own.T == pytest.approx(end.rotation, abs=EXACT)
        assert spin == pytest.approx(twist.angular, abs=EXACT)
        assert place == pytest.approx(end.act(tip), abs=EXACT)
        assert rate == pytest.approx(twist.linear + np.cross(twist.angular, end.rotation @ tip), abs=EXACT)


def test_wrenches_from_outside_are_taken_off():
    tree = canted()
    model, data, rng = SpatialModel(tree), tree.createData(), np.random.default_rng(1)
    force, moment, body = rng.normal(size=3) * 50, rng.normal(size=3) * 10, 6
    own = model.bodies[body].own  # axes in which both are given
    q, v, a = (ca.SX.sym(k, len(model.names)) for k in "qva")
    s = SpatialState(model, q, v, a)
    told = ca.Function("told", [q, v, a], s.dynamics({body: (ca.DM(force), ca.DM(moment))}))
    chart = [x[:1] for x in states(len(model.names))]
    found = [x.full().squeeze() for x in told(*(x[0] for x in chart))]
    motion = [x[0] for x in model.to_pinocchio(*chart)]
    outside = pin.StdVec_Force([pin.Force.Zero() for _ in range(tree.njoints)])
    outside[body + 1] = pin.Force(own @ force, own @ moment)
    need = pin.rnea(tree, data, *motion, outside)
    pin.forwardKinematics(tree, data, motion[0])
    base = data.oMi[1].rotation
    assert not np.allclose(own, np.eye(3))
    for mine, theirs in zip(found, (base @ need[:3], base @ need[3:6], need[6:]), strict=True):
        assert mine == pytest.approx(theirs, abs=EXACT)


def test_rates_and_accelerations_of_points_are_pinocchios():
    """In the body's own axes; and the place of a point seen from the base, in the base's."""
    tree = canted()
    model, data = SpatialModel(tree), tree.createData()
    tip, local = np.array([0.1, 0.2, 0.3]), pin.ReferenceFrame.LOCAL
    q, v, a = (ca.SX.sym(k, len(model.names)) for k in "qva")
    s, bodies = SpatialState(model, q, v, a), (0, 4, model.joints)
    places = [model.local(body + 1, tip) for body in bodies]
    told = []
    for body, place in zip(bodies, places, strict=True):
        told += [*s.own_rates(body, place), *s.own_accelerations(body, place)]
        told.append(s.from_base(body, place))
    told = ca.Function("told", [q, v, a], told)
    charts = states(len(model.names))
    motions = model.to_pinocchio(*charts)
    for row in range(len(charts[0])):
        found = [x.full().ravel() for x in told(*(x[row] for x in charts))]
        pin.forwardKinematics(tree, data, *(x[row] for x in motions))
        for k, body in enumerate(bodies):
            speed, spin, gain, turning, seen = found[5 * k : 5 * k + 5]
            own, rate = model.bodies[body].own, pin.getVelocity(tree, data, body + 1, local)
            more = pin.getClassicalAcceleration(tree, data, body + 1, local)
            along = np.cross(rate.angular, tip)
            gained = more.linear + np.cross(more.angular, tip) + np.cross(rate.angular, along)
            assert own @ speed == pytest.approx(rate.linear + along, abs=EXACT)
            assert own @ spin == pytest.approx(rate.angular, abs=EXACT)
            assert own @ gain == pytest.approx(gained, abs=1e-8)
            assert own @ turning == pytest.approx(more.angular, abs=1e-8)
            assert seen == pytest.approx(data.oMi[1].actInv(data.oMi[body + 1].act(tip)), abs=EXACT)


def test_charts_come_back_from_pinocchio_on_all_three_levels():
    model = SpatialModel(canted())
    rng, t = np.random.default_rng(4), np.linspace(0, 1, 300)[:, None]
    q = t * np.array([0.3, -0.2, 1.0, -4 * np.pi, 0.9, 4 * np.pi, *np.ones(model.joints)])
    v, a = 3 * rng.normal(size=q.shape), 20 * rng.normal(size=q.shape)
    told = model.to_pinocchio(q, v, a)
    for mine, theirs in zip(model.charts(*told), (q, v, a), strict=True):
        assert mine == pytest.approx(theirs, abs=1e-8)
    late = model.charts(*(x[200:] for x in told), near=q[199, 3:6])[0]
    assert late == pytest.approx(q[200:], abs=1e-8)


def test_chart_counts_full_turns_there_and_back():
    model = SpatialModel(canted())
    t = np.linspace(0, 1, 400)[:, None]
    q = t * np.array([0.3, -0.2, 1.0, -4 * np.pi, 0.9, 4 * np.pi, *np.ones(model.joints)])
    there = model.to_pinocchio(q, 0 * q, 0 * q)[0]
    assert np.abs(np.linalg.norm(there[:, 3:7], axis=1) - 1).max() < EXACT
    assert np.abs(np.diff(there[:, 3:7], axis=0)).max() < 0.1  # the quaternion follows whole turns without a jump
    assert model.of_pinocchio(there) == pytest.approx(q, abs=EXACT)
    assert model.of_pinocchio(there[-1:], near=q[-1, 3:6])[0] == pytest.approx(q[-1], abs=EXACT)


def test_twists_are_the_rates_of_configurations():
    tree = canted()
    model, h = SpatialModel(tree), 1e-6
    q, v, a = states(len(model.names), 1)
    around = [q + s * h * v + s * s * h * h / 2 * a for s in (-1, 1)], [v + s * h * a for s in (-1, 1)]
    (before, after), (v0, v1) = around
    here = [x[0] for x in model.to_pinocchio(q, v, a)]
    ends = [model.to_pinocchio(x, w, a) for x, w in ((before, v0), (after, v1))]
    moved = pin.difference(tree, ends[0][0][0], ends[1][0][0]) / (2 * h)
    assert moved == pytest.approx(here[1], rel=1e-6, abs=1e-6)
    assert (ends[1][1][0] - ends[0][1][0]) / (2 * h) == pytest.approx(here[2], rel=1e-6, abs=1e-5)


def test_rates_are_derivatives_in_time():
    x, v, a = (ca.SX.sym(k, 2) for k in "xva")

    def column(q):
        return ca.vertcat(ca.sin(q[0]) * q[1], q[1] ** 2)

    found = ca.Function("f", [x, v, a], [*rates(column, x, v, a)])
    q, w, b = np.array([0.3, -0.7]), np.array([1.1, 0.4]), np.array([-2.0, 0.5])
    h = 1e-5
    along = np.array([ca.DM(column(ca.DM(q + s * h * w + s * s * h * h / 2 * b))).full() for s in (-1, 0, 1)]).squeeze()
    first, second = (y.full().squeeze() for y in found(q, w, b))
    assert first == pytest.approx((along[2] - along[0]) / (2 * h), abs=1e-8)
    assert second == pytest.approx((along[2] - 2 * along[1] + along[0]) / h**2, abs=1e-4)


def test_joints_that_turn_for_ever_are_refused():
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.addJoint(joint, pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    model.name = "cart"
    with pytest.raises(RobotError) as e:
        SpatialModel(model)
    assert str(e.value) == "robot cart: joint 'wheel' is no joint that turns in a range"


def test_free_base_is_needed():
    model = pin.Model()
    model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    model.name = "arm"
    with pytest.raises(RobotError) as e:
        SpatialModel(model)
    assert str(e.value) == "robot arm: the spatial model takes a free base and joints of one axis each"
