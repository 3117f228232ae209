"""The model of any tree in space against Pinocchio: dynamics, momentum, places, and the chart of the base.

And even motions, in which the left half stands for both: against the whole tree, and as whole motions of a robot.
"""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import casadi as ca
import fixtures_robots as robots
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, planner, refused

from jumplab.errors import RobotError
from jumplab.models.spatial import SpatialModel, SpatialState
from jumplab.ocp.problem import Point
from jumplab.robot import Robot
from jumplab.stages.whole_body import coordinates
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.problem import Schedule

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
    assert np.abs(np.diff(told[0][:, 3:7], axis=0)).max() < 0.1  # the quaternion follows whole turns without a jump
    for mine, theirs in zip(model.charts(*told), (q, v, a), strict=True):
        assert mine == pytest.approx(theirs, abs=1e-8)
    late = model.charts(*(x[200:] for x in told), near=q[199, 3:6])[0]
    assert late == pytest.approx(q[200:], abs=1e-8)


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


def test_the_rate_of_the_inertia_is_its_derivative_in_time():
    model = SpatialModel(canted())
    q, v = (ca.SX.sym(k, len(model.names)) for k in "qv")
    state = SpatialState(model, q, v, 0 * v)
    told = ca.Function("told", [q, v], [state.rho, state.rho_rate])
    chart, rates, _ = (x[0] for x in states(len(model.names)))
    h = 1e-6
    before, after = (float(told(chart + s * h * rates, rates)[0]) for s in (-1, 1))
    assert float(told(chart, rates)[1]) == pytest.approx((after - before) / (2 * h), rel=1e-6)


def test_joints_that_turn_for_ever_are_refused():
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root")
    model.addJoint(joint, pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    model.name = "cart"
    assert refused(SpatialModel, model, by=RobotError) == "robot cart: joint 'wheel' must be revolute and have a range"


def test_free_base_is_needed():
    model = pin.Model()
    model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    model.name = "arm"
    said = refused(SpatialModel, model, by=RobotError)
    assert said == "robot arm: the spatial model needs a free base and joints of one degree of freedom each"


# even motions -----------------------------------------------------------------------------------------------------
def canted_shoulders(urdf: str = robots.GOOD, config: str = robots.config("canted_shoulders")) -> Robot:
    """A robot with shoulders that turn about axes 0.3 rad off the pitch axis, as mirror images."""
    robot = ET.fromstring(urdf)
    angle = 0.3
    for side, sign in (("left", 1), ("right", -1)):
        axis = f"0 {math.cos(angle):.12f} {sign * math.sin(angle):.12f}"
        robots.joint(robot, f"{side}_shoulder_pitch").find("axis").set("xyz", axis)
    return Robot.from_text(robots.text(robot), config)


def free_waist() -> Robot:
    """The same with a chest above the pelvis, and a pitch joint between them that moves: one in the middle."""
    urdf, config = robots.waist()
    return canted_shoulders(urdf, config.partition("[locked]")[0])


# name -> kind of even coordinates, how many there are, and the robot
EVEN = {"bhr": ("plane", 7, Robot.load), "canted": ("even", 10, canted_shoulders), "waist": ("even", 11, free_waist)}


@cache
def body_of(name: str) -> Body:
    return Body(EVEN[name][2]())


def even_motion(free: coordinates.Coordinates, count: int = 4):
    """Random motions of the free coordinates (count, .), several full turns of pitch among them."""
    rng = np.random.default_rng(7)
    q, v, a = (size * rng.normal(size=(count, free.size)) for size in (1.0, 3.0, 20.0))
    q[:, 2] *= 6
    return q, v, a


def mirrored(x: np.ndarray, moment: bool = False) -> np.ndarray:
    """The mirror image of a force or velocity in the x-z plane; of a moment or angular velocity."""
    return x * ([-1.0, 1.0, -1.0] if moment else [1.0, -1.0, 1.0])


@pytest.mark.parametrize("name", EVEN)
def test_the_left_half_of_an_even_motion_stands_for_the_whole_tree(name):
    """Dynamics with a wrench on each foot, momentum and CoM; torques of the left half and of the middle."""
    body, kind, size = body_of(name), *EVEN[name][:2]
    free = coordinates.even(body)
    tree = body.robot.model.copy()
    assert (free.kind, free.size, free.even) == (kind, size, True)
    tree.armature[6:] = 0.02
    model = SpatialModel(tree)
    n = len(model.names)
    kept = [k - 1 for k in model.left_half if k]
    left, right = body.feet
    rng = np.random.default_rng(2)
    assert left in model.left_half and right not in model.left_half
    q, v, a, loads = (ca.SX.sym(k, size) for k, size in (("q", n), ("v", n), ("a", n), ("loads", 12)))
    push = {left: (loads[:3], loads[3:6]), right: (loads[6:9], loads[9:])}
    whole, half = (SpatialState(model, q, v, a, even=even) for even in (False, True))
    told = []
    for state, wrenches in ((whole, push), (half, {left: push[left]})):
        force, moment, torques = state.dynamics(wrenches)
        told += [force, moment, torques[kept], state.com, state.com_velocity, state.angular_momentum]
    told = ca.Function("told", [q, v, a, loads], told)
    turns = ca.Function("turns", [q], [whole.rotation(k) for k in (left, right)])
    for motion in zip(*even_motion(free), strict=True):
        chart = [free.charts(x[None], level)[0] for level, x in enumerate(motion)]
        force = 100 * rng.normal(size=3)
        moment = 20 * rng.normal(size=3)
        axes = [x.full() for x in turns(chart[0])]
        given = [axes[0].T @ force, axes[0].T @ moment]
        given += [axes[1].T @ mirrored(force), axes[1].T @ mirrored(moment, True)]
        found = [x.full().ravel() for x in told(*chart, np.concatenate(given))]
        for mine, theirs in zip(found[6:], found[:6], strict=True):
            assert mine == pytest.approx(theirs, abs=EXACT)
        assert np.abs(found[0][[0, 2]]).min() > 1 and np.abs(found[5][1]) > 1e-3  # there is something to compare


@pytest.mark.parametrize("name", EVEN)
def test_even_motions_are_mirror_images(name):
    """Through Pinocchio: the CoM stays in the plane, momentum too; feet are in mirrored places at mirrored speeds."""
    body = body_of(name)
    free = coordinates.even(body)
    tree = body.robot.model
    data = body.robot.model.createData()
    charts = [free.charts(x, level) for level, x in enumerate(even_motion(free))]
    axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    frames = [tree.getFrameId(frame) for frame in body.robot.foot.frames]
    for q, v, _ in zip(*body.model.to_pinocchio(*charts), strict=True):
        momentum = pin.computeCentroidalMomentum(tree, data, q, v)
        assert data.com[0][1] == pytest.approx(0.0, abs=EXACT)
        assert momentum.vector[[1, 3, 5]] == pytest.approx(0.0, abs=1e-8)
        pin.framesForwardKinematics(tree, data, q)
        places = [data.oMf[frame].act(body.robot.foot.tip) for frame in frames]
        assert places[1] == pytest.approx(mirrored(places[0]), abs=EXACT)
        pin.forwardKinematics(tree, data, q, v)
        twists = [pin.getFrameVelocity(tree, data, frame, axes) for frame in frames]
        assert twists[1].linear == pytest.approx(mirrored(twists[0].linear), abs=1e-8)
        assert twists[1].angular == pytest.approx(mirrored(twists[0].angular, True), abs=1e-8)


@pytest.mark.parametrize("kind", [coordinates.whole, coordinates.even, coordinates.in_plane])
@pytest.mark.parametrize("name", EVEN)
def test_charts_are_the_same_in_symbols_and_in_numbers(name, kind):
    """On all three levels; what a phase has besides is passed over, and the free coordinates come back."""
    body = body_of(name)
    free = kind(body)
    x = ca.SX.sym("x", free.size + 1)
    seen = ca.Function("seen", [x], [free.chart(x, level) for level in range(3)])
    for level, values in enumerate(even_motion(free)):
        told = free.charts(np.column_stack([values, np.ones(len(values))]), level)
        assert told.shape == (len(values), len(body.model.names))
        assert told == pytest.approx(free.charts(values, level), abs=0)
        for row, chart in zip(values, told, strict=True):
            assert seen(np.append(row, 1.0))[level].full().ravel() == pytest.approx(chart, abs=1e-12)
        assert free.taken(told) == pytest.approx(values, abs=1e-12)
    assert free.charts(free.taken(body.stance[None]))[0] == pytest.approx(body.stance, abs=1e-9)
    assert free.charts(np.zeros((1, free.size)), 1) == pytest.approx(0.0, abs=0)


@pytest.mark.parametrize("name", EVEN)
def test_bounds_of_free_coordinates_are_the_tighter_of_both_sides(name):
    """Just inside, the whole chart is inside its bounds; just outside, it is not."""
    body = body_of(name)
    free = coordinates.even(body)
    rng = np.random.default_rng(3)
    n = len(body.model.names)
    low = -rng.uniform(1, 2, n)
    high = rng.uniform(1, 2, n)
    least, most = free.within(low, high)
    moved = np.abs(free.spread).any(axis=1)
    for end, way in ((least, 1), (most, -1)):
        for k in range(free.size):
            inside, outside = (np.zeros(free.size) for _ in range(2))
            inside[k] = end[k] + 1e-9 * way
            outside[k] = end[k] - 1e-9 * way
            for x, kept in ((inside, True), (outside, False)):
                chart = (free.charts(x[None], 1)[0])[moved]
                assert np.all((low[moved] <= chart) & (chart <= high[moved])) == kept


# a planar plan is one of all coordinates --------------------------------------------------------------------------
def along(phase, solution, parameters) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Term -> its values (rows, nodes) at the nodes of a solution that it is for, with lower and upper end (rows, 1).

    References are zeros: soles in the air are asked to be above the ground, by nothing more.
    """
    count = phase.intervals
    out = {}
    sizes = {"q": solution.q.shape[1], "v": solution.q.shape[1], "a": solution.q.shape[1], "z": solution.z.shape[1]}
    x = {name: ca.SX.sym(name, size) for name, size in (*sizes.items(), ("s", 1))}
    given = solution.constants, parameters, {name: np.zeros(n) for name, n in phase.references.items()}
    spaces = (SimpleNamespace(**{n: ca.SX(ca.DM(np.atleast_1d(y))) for n, y in z.items()}) for z in given)
    moved = [x[k] for k in "qva"]
    duration = ca.SX(solution.duration)
    point = Point(*moved, None, x["z"], duration, x["s"], *spaces, view=phase.view)
    for term in phase.terms:
        if term.is_cost or term.at not in ("node", "end"):
            continue
        first, last = (term.skip[0], count - term.skip[1]) if term.at == "node" else (count, count)
        told = ca.Function("told", list(x.values()), [term.expression(point)])
        nodes = range(first, last + 1)
        columns = [told(*(getattr(solution, k)[n] for k in sizes), n / count).full().ravel() for n in nodes]
        values = np.array(columns).T
        ends = []
        for end in (term.lower, term.upper):
            end = end(parameters) if callable(end) else end
            ends.append(np.broadcast_to(np.asarray(end, float).ravel(), len(values))[:, None])
        out[term.name] = values, *ends
    return out


@pytest.mark.parametrize("target", [(1.0, 0.5, 0.0, "direct"), (0.6, 0.5, 0.3, "three-step")], ids=str)
def test_the_phases_of_a_planar_plan_meet_the_rows_of_the_whole_program(target):
    """With every coordinate of both sides: contact, dynamics and flight as exactly as in the plane, limits too."""
    body = jump(*target).whole_body
    stages = planner()
    assert body.schedule.free.plane and not body.schedule.whole.free.even
    aside = replace(body.task, yaw_rad=0.1)  # whose program has every coordinate
    data = stages.program(aside).parameters(body.task)
    own = stages.program().parameters(body.task) | dict(momentum=0.0, launch_s=np.zeros(2))
    of = body.schedule
    # deep squats, of which the program of all coordinates has none, are for both legs alike
    deep = Schedule(of.body, of.contacts, replace(of.limits, knee_rad=np.pi), of.weights)
    assert [list(p.q.shape) for p in body.phases.values()] == [[13, 20], [9, 22], [13, 20]]
    for plane, whole in zip(of.problem().phases, deep.problem().phases, strict=True):
        told = along(plane, body.solution.phases[plane.name], own)
        found = along(whole, body.phases[whole.name], data)
        equal = {name for name, (_, low, high) in found.items() if np.array_equal(low, high)}
        missed = {name: np.abs(values).max() for name, (values, _, _) in told.items() if name in equal}
        for side in ("left", "right"):
            missed |= {n.replace("left", side): x for n, x in missed.items() if n.startswith("left foot")}
        assert set(missed) == equal and equal >= {"base forces", "base moments", "joint dynamics"}
        for name in equal:
            assert np.abs(found[name][0]).max() <= missed[name] + 1e-9, name
        for side in [] if whole.name == "flight" else ["left", "right"]:
            most = max(1e-6, body.solution.statistics.residual)  # the latter where the solver ended early
            assert np.abs(found[f"{side} foot in place"][0]).max() <= most
        # the plane asks for no soles that stick
        for name in set(found) - equal - {"soles that stick at touchdown"}:
            values, low, high = found[name]
            assert np.maximum(low - values, values - high).max() < 1e-4, name
        for bound in whole.bounds:
            x = getattr(body.phases[whole.name], bound.on)
            rows = {"all": x, "inner": x[1:], "start": x[:1], "end": x[-1:]}[bound.where]
            low, high = (np.asarray(y(data) if callable(y) else y) for y in (bound.lower, bound.upper))
            assert np.maximum(low - rows, rows - high).max() < 1e-4, bound.name
