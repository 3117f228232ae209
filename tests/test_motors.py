"""Armature, friction and no-load speed of motors: read, refused, planned with, audited, simulated, exported."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import config, refused, root, text
from paper.planar import evaluator

from jumplab.auditing.audit import audit
from jumplab.auditing.report import METHOD
from jumplab.errors import RobotError
from jumplab.io import export
from jumplab.io.motion import Motion
from jumplab.robot import Robot, changes
from jumplab.robot.files import read_toml
from jumplab.robot.motors import SLIDING_RATE
from jumplab.robot.sagittal import JOINT_OF_ANGLES
from jumplab.robot.stance import stance_configuration
from jumplab.robot_import.checks import read_tree
from jumplab.robot_import.jumper import make_jumper
from jumplab.sim import INSTALLED, STEP_S, simulate_jump
from jumplab.sim.armature import Armature
from jumplab.sim.checks import check
from jumplab.sim.engine import engine_class
from jumplab.stages.planner import Planner
from jumplab.stages.whole_body import Limits, Mesh, Weights
from jumplab.stages.whole_body.body import Body
from jumplab.stages.whole_body.contacts import jump_contacts
from jumplab.stages.whole_body.coordinates import BASE, even, whole
from jumplab.stages.whole_body.instant import Instant
from jumplab.stages.whole_body.mode import Mode
from jumplab.stages.whole_body.problem import Schedule
from jumplab.task import JumpTask

NUMBERS = {"hip_pitch": (0.03, 1.5, 0.15), "knee": (0.04, 2.0, 0.2), "ankle_pitch": (0.02, 1.0, 0.1),
           "shoulder_pitch": (0.01, 0.5, 0.05)}  # fmt: skip
KEYS = "armature", "friction", "damping"
KNEE = "[limits.knee]\n"


def with_motors(robot: Robot, keys=KEYS, **more) -> Robot:
    """A robot whose pitch joints have motors, of which ``keys`` are known; ``more`` are further tables."""
    told = ""
    for key, column in zip(KEYS, zip(*NUMBERS.values(), strict=True), strict=True):
        if key in keys:
            rows = zip(NUMBERS, column, strict=True)
            told += f"\n[actuators.{key}]\n" + "".join(f"{n} = {x}\n" for r, x in rows for n in robot.joints[r])
    for key, rows in more.items():
        told += f"\n[actuators.{key}]\n" + "".join(f"{n} = {x}\n" for n, x in rows.items())
    return Robot(robot.urdf, robot.config_text + told)


@pytest.fixture(scope="module")
def heavy(bhr):
    return with_motors(bhr)


@pytest.fixture(scope="module")
def plan(heavy):
    return Planner(heavy).plan(JumpTask(0.4, 0.2))


# told ---------------------------------------------------------------------------------------------------------------
def imported(told: str) -> Robot:
    return make_jumper(read_tree(text(root()), "my.urdf"), read_toml(config("x") + told, "config"))[0]


def test_read_for_a_role_and_for_one_of_its_joints():
    robot = imported(KNEE + 'source = "a catalogue"\nvelocity = 20.0\ncorner = 15.0\nno_load = 25.0\narmature = 0.05\n'
                     "friction = 2.0\ndamping = 0.1\n[limits.right_knee]\narmature = 0.06\n")  # fmt: skip
    left, right, hip = (robot.actuators[name] for name in ("left_knee", "right_knee", "left_hip_pitch"))
    assert [left[k] for k in (*KEYS, "corner_speed", "no_load_speed")] == [0.05, 2.0, 0.1, 15.0, 25.0]
    assert [right[k] for k in KEYS] == [0.06, 2.0, 0.1]
    assert [hip[k] for k in KEYS] == [0.0, 0.0, 0.0] and hip["no_load_speed"] == hip["speed"]
    s = robot.sagittal  # both sides together; of the speeds, the lower one
    assert [s.armature[1], s.friction[1], s.damping[1], s.no_load_speed[1]] == pytest.approx([0.11, 4.0, 0.2, 25.0])
    assert not s.armature[[0, 2, 3]].any()


def test_kept_by_what_makes_other_robots():
    robot = imported(KNEE + "velocity = 20.0\nno_load = 25.0\narmature = 0.05\nfriction = 2.0\n")
    others = robot.with_limits(effort=0.9, speed=0.8), robot.with_mass("trunk", factor=1.1), robot.with_legs(1.02)
    for other in (*others, robot.with_stance(knee_rad=0.6), pickle.loads(pickle.dumps(robot))):
        assert np.array_equal(other.limits.armature, robot.limits.armature) and other.limits.lossy
        assert np.array_equal(other.model.armature[6:], robot.limits.armature)
    assert others[0].actuators["left_knee"]["no_load_speed"] == pytest.approx(20.0)  # with the speed limit


def test_a_corner_beyond_the_speed_limit_needs_a_no_load_speed():
    robot = imported(KNEE + "velocity = 10.0\ncorner = 12.0\nno_load = 15.0\n")
    assert robot.actuators["left_knee"]["corner_speed"] == pytest.approx(12.0)


def test_a_robot_without_such_numbers_is_as_ever(bhr):
    assert not bhr.limits.armature.any() and not bhr.limits.lossy and not bhr.model.armature.any()
    assert np.array_equal(bhr.limits.no_load_speed, bhr.limits.speed) and not any(bhr.motors.values())


def test_rotors_by_estimate(bhr):
    """Peak torque^1.5 gives the G1's three motors within a third; what has an armature keeps it."""
    heavier = bhr.with_rotors(2.0)
    for name, x in heavier.actuators.items():
        assert x["armature"] == pytest.approx(2 * 2.2e-5 * x["effort"] ** 1.5, rel=1e-3)
        assert heavier.model.armature[heavier.model.idx_vs[heavier.model.getJointId(name)]] == x["armature"]
    for effort, armature in ((111.0, 0.0251), (71.0, 0.01018), (24.8, 0.00361)):  # as its maker publishes them
        assert 0.75 < 2.2e-5 * effort**1.5 / armature < 1.34
    again = replace(bhr, config_text=f'{bhr.config_text}\narmature = {{left_knee = 0.5}}').with_rotors()
    assert (again.actuators["left_knee"]["armature"], again.actuators["right_knee"]["armature"]) == (0.5, 0.06695)
    known = "robot bhr: the armature of all its motors is known; leave out with_rotors"
    assert refused(heavier.with_rotors, by=RobotError) == known
    no_factor = "robot bhr: the factor on rotors must be a positive number, got 0"
    assert refused(bhr.with_rotors, 0, by=RobotError) == no_factor


@pytest.mark.parametrize("told, sentence", [
    ("armature = -0.1\n", "armature = -0.1 must not be negative"),
    ("friction = -1.0\n", "friction = -1 must not be negative"),
    ("damping = -1.0\n", "damping = -1 must not be negative"),
    ("armature = 25.0\n", "armature = 25 kg m^2 must be at most 10 kg m^2, as joints have"),
    ("effort = 50.0\nvelocity = 20.0\nfriction = 10.0\ndamping = 2.0\n",
     "friction and damping take 50 N m at the speed limit, and the effort is 50 N m"),
    ("velocity = 20.0\nno_load = 15.0\n",
     "no_load = 15 rad/s is below the speed limit, 20 rad/s, at which it would give no torque"),
    ("velocity = 20.0\nno_load = 25.0\ncorner = 25.0\n",
     "corner = 25 rad/s must lie between 0 and the no-load speed, 25 rad/s"),
])  # fmt: skip
def test_refused(told, sentence):
    assert refused(lambda: imported(KNEE + told)) == f"my.urdf: joint 'left_knee': {sentence}; correct [limits.knee]"


@pytest.mark.parametrize("told, sentence", [
    ({"armature": {"left_knee": -1.0}}, "armature: left_knee = -1 must name a joint that moves, and be at least 0"),
    ({"friction": {"neck": 1.0}}, "friction: neck = 1 must name a joint that moves, and be at least 0"),
    ({"no_load_ratios": {"left_knee": 0.9}},
     "no_load_ratios: left_knee = 0.9 must name a joint that moves, and be at least 1"),
    ({"no_load_ratios": {"left_knee": 1.2}, "corner_speed_ratios": {"left_knee": 1.2}},
     "corner_speed_ratios: left_knee = 1.2 must name a joint, and lie between 0 and 1.2"),
])  # fmt: skip
def test_refused_of_a_robot(bhr, told, sentence):
    assert refused(lambda: with_motors(bhr, (), **told)) == f"robot bhr: {sentence}"


def test_a_source_is_a_text():
    assert refused(imported, KNEE + "source = 3\n", by=RobotError).endswith("'limits.knee.source' = 3, must be a text")


# planned ------------------------------------------------------------------------------------------------------------
def test_five_links_turn_the_motors_too(bhr, heavy):
    """Torques less those of the robot without motors are J q'' + d q' + f tanh(q' / r), of both sides."""
    rng, s = np.random.default_rng(1), heavy.sagittal
    of = [evaluator(robot.sagittal) for robot in (heavy, bhr)]
    for size in (0.01, 1.0, 10.0):
        angles, rates, accels = rng.normal(size=5), size * rng.normal(size=5), 10 * size * rng.normal(size=5)
        given, needed = (f(angles, rates, accels, np.zeros(2))[9].full().ravel() for f in of)
        rate, accel = JOINT_OF_ANGLES @ rates, JOINT_OF_ANGLES @ accels
        told = s.armature * accel + s.damping * rate + s.friction * np.tanh(rate / SLIDING_RATE)
        np.testing.assert_allclose(given - needed, told, atol=1e-9)
    assert s.armature == pytest.approx([0.06, 0.08, 0.04, 0.02])


def test_the_tree_turns_the_motors_too(heavy):
    """Torques in flight are Pinocchio's without motors, plus what armature and damping take."""
    b = Mode(Body(heavy), Limits(), Weights(), "-")
    n, rng = len(b.coordinates), np.random.default_rng(2)
    q, v, a = (ca.SX.sym(key, n) for key in "qva")
    point = SimpleNamespace(q=q, v=v, a=a, p=SimpleNamespace(gravity=9.8), memo={})
    needed = ca.Function("needed", [q, v, a], [Instant(b, point).needed[2]])
    chart, rates, accels = 0.3 * rng.normal(size=(3, n))
    told = needed(chart, rates, accels).full().ravel()
    model = pin.buildModelFromXML(heavy.urdf, pin.JointModelFreeFlyer())  # knows nothing of motors
    model.gravity.linear = np.array([0.0, 0.0, -9.8])
    own = [x[0] for x in b.model.to_pinocchio(chart[None], rates[None], accels[None])]
    rigid = pin.rnea(model, model.createData(), *own)[6:]
    armature, damping = (getattr(heavy.limits, key) for key in ("armature", "damping"))
    motors = armature * accels[BASE:] + damping * rates[BASE:]
    np.testing.assert_allclose(told, rigid + motors, atol=1e-9)


@pytest.mark.parametrize("coordinates", [whole, even], ids=["in space", "in the plane"])
def test_dry_friction_lowers_the_limits_of_torques(bhr, heavy, coordinates):
    """A joint that moves has that much less to give, whichever way; the rows have no kink."""
    limits, bounds, lines = Limits(), [], []
    for robot in (bhr, heavy):
        body = Body(robot)
        free = coordinates(body)
        contacts = jump_contacts(limits, Mesh())
        problem = Schedule(body, contacts, limits, Weights(), free=free).problem()
        bounds.append([x for _, x in problem.bounds() if x.name == "forces and torques"])
        lines.append([t for _, t in problem.terms() if t.name == "torque-speed"])
    friction, effort = (getattr(heavy.limits, key)[free.joints] for key in ("friction", "effort"))
    assert len(friction) == (4 if free.plane else 14)
    for free, less in zip(*bounds, strict=True):
        for side in ("lower", "upper"):
            push, torque = np.split(getattr(less, side), [-len(friction)])
            assert np.array_equal(push, getattr(free, side)[: len(push)])
            sign = -1 if side == "lower" else 1
            most = limits.torque_share * effort - friction
            np.testing.assert_allclose(sign * torque, most)
    for free, less in zip(*lines, strict=True):
        np.testing.assert_allclose(free.upper - less.upper, friction / effort)
        np.testing.assert_allclose(less.lower, -less.upper)


def rigid_torques(robot: Robot, tape) -> np.ndarray:
    """Inverse dynamics of a tape without motors (N, nv - 6) [N m]."""
    model = pin.buildModelFromXML(robot.urdf, pin.JointModelFreeFlyer())
    model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])
    data, out = model.createData(), []
    frames = [model.getFrameId(str(name)) for name in tape.contact_frames]
    for q, v, a, f in zip(tape.q, tape.v, tape.a, tape.f, strict=True):
        need = pin.rnea(model, data, q, v, a).copy()
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        for frame, wrench in zip(frames, f, strict=True):
            need -= pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED).T @ wrench
        out.append(need[6:])
    return np.array(out)


@pytest.mark.parametrize("target", [
    JumpTask(0.4, 0.2), pytest.param(JumpTask(0.1, 0.25, side_m=0.1), marks=pytest.mark.slow),
], ids=["ahead", "in space"])  # fmt: skip
def test_a_planned_tape_holds_motor_torques_within_the_motors(heavy, plan, target):
    plan = plan if target == plan.task else Planner(heavy).plan(target)
    tape, limits = plan.tape, heavy.limits
    assert audit(tape, plan.robot, plan.task).passed
    motors = limits.armature * tape.a[:, 6:] + limits.lost(tape.v[:, 6:])
    np.testing.assert_allclose(tape.tau, rigid_torques(heavy, tape) + motors, atol=1e-6)
    assert np.abs(motors).max() > 3.0 and np.all(np.abs(tape.tau) < limits.effort)


@pytest.mark.parametrize("key", KEYS)
def test_the_audit_misses_what_a_tape_leaves_out(heavy, plan, key):
    """A tape whose torques lack armature, friction or damping is no jump of this robot."""
    tape, rate = plan.tape, plan.tape.v[:, 6:]
    own = {"armature": tape.a[:, 6:], "damping": rate, "friction": np.tanh(rate / SLIDING_RATE)}[key]
    lacking = replace(tape, tau=tape.tau - getattr(heavy.limits, key) * own)
    found = {c.name: c for c in audit(lacking, plan.robot, plan.task).checks}["joint torque consistency"]
    worst = 100 * np.abs(getattr(heavy.limits, key) * own / heavy.limits.effort).max()
    assert not found.passed and found.value == pytest.approx(worst, rel=1e-3)


def test_energy_counts_rotors_and_losses(bhr, heavy, plan):
    """Energy of motors is in links and rotors, or lost: without either, the balance is off by as much."""

    def found(robot):
        return {c.name: c.value for c in audit(plan.tape, robot, plan.task).checks}["energy balance"]

    assert found(heavy) < 0.05 < 1.0 < found(bhr)


def test_torque_at_speed_ends_at_the_no_load_speed(bhr):
    robot = with_motors(bhr, (), no_load_ratios={"left_knee": 1.5, "right_knee": 1.5})
    knee = robot.actuators["left_knee"]
    assert (knee["speed"], knee["corner_speed"], knee["no_load_speed"]) == (20.0, 10.0, 30.0)
    low, high = robot.limits[[robot.joint_names.index("left_knee")] * 4].range(np.array([10.0, 20.0, 30.0, -10.0]))
    np.testing.assert_allclose([low, high], knee["effort"] * np.array([[-1, -1, -1, -1], [1, 0.5, 0, 1]]))
    assert robot.sagittal.no_load_speed[1] == 30.0 and METHOD.torque_floor == 0.01


# simulated ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("engine", INSTALLED)
@pytest.mark.parametrize("keys", [("armature",), ("armature", "damping"), KEYS], ids=len)
def test_a_pendulum_with_a_motor(bhr, engine, keys):
    """An arm on a trunk that nothing moves: I q'' = tau - f - d q', from rest and in free fall, in closed form."""
    heavy, _ = changes.masses(bhr, "trunk", 1e7, None)  # heavier than a robot that is read
    robot = with_motors(Robot(heavy, bhr.config_text), keys)
    k, model = robot.joint_names.index("left_shoulder_pitch"), robot.model
    data, q = model.createData(), stance_configuration(robot).copy()
    q[2] = 10.0
    inertia = pin.crba(model, data, q)[6 + k, 6 + k]
    row, torque, steps = robot.actuators["left_shoulder_pitch"], 3.0, 100
    assert row["armature"] > 0.05 * (inertia - row["armature"])
    tau = np.zeros(model.nv - 6)
    tau[k] = torque
    with engine_class(engine)(robot, q) as world:
        assert world.read_back()["inertia_error"] < 1e-6 and world.kept().damping == 0
        for _ in range(steps):
            world.set_torque(tau)
            world.step()
        rate, t = world.state()[1][6 + k], steps * STEP_S
    push, damping = torque - row["friction"], row["damping"]
    due = push / damping * (1 - np.exp(-damping * t / inertia)) if damping else push * t / inertia
    assert rate == pytest.approx(due, rel=2e-3 if keys != KEYS else 2e-2)  # engines let dry friction grow with the rate


def test_lent_inertia_is_reckoned_as_an_engine_feels_it_in_an_impact(heavy):
    """By inverse dynamics of the tree with and without it, in a step that turns joints by 30 rad/s."""
    robot, rng = heavy, np.random.default_rng(0)
    model = robot.model
    q, v = [stance_configuration(robot)], [rng.normal(0.0, 2.0, model.nv)]
    for faster in (1.0, 30.0):
        v.append(v[-1] + faster * rng.normal(size=model.nv))
        q.append(pin.integrate(model, q[-1], STEP_S * v[-1]))
    engine = Armature(robot)
    lent = model.copy()
    for link, inertia in engine.lent.items():
        body = lent.frames[lent.getFrameId(link, pin.FrameType.BODY)].parentJoint
        lent.inertias[body] += pin.Inertia(0.0, np.zeros(3), inertia * np.eye(3))
    engine.returned(q[0], v[0])
    given = engine.returned(q[1], v[1])
    gained = (v[2] - v[1]) / STEP_S
    felt, bare = (pin.rnea(tree, tree.createData(), q[1], v[1], gained) for tree in (lent, model))
    felt[6:] -= robot.limits.armature * gained[6:]
    late = Armature(robot).late(np.array(q), np.array(v))[1]
    assert np.abs(late).max() > 10.0
    np.testing.assert_allclose(late, given - (felt - bare), atol=1e-8 * np.abs(late).max())


@pytest.mark.parametrize("engine", INSTALLED)
def test_a_robot_in_the_air_moves_as_with_armature(bhr, engine):
    """Against Pinocchio's forward dynamics; PyBullet gives a part of it a step late."""
    robot = with_motors(bhr, ("armature",))
    model, data = robot.model, robot.model.createData()
    q, v = stance_configuration(robot).copy(), np.zeros(model.nv)
    q[2] = 5.0
    with engine_class(engine)(robot, q) as world:
        for k in range(100):
            tau = 10.0 * np.sin(0.05 * k + np.arange(model.nv - 6)) * np.isin(np.arange(model.nv - 6) % 7, (2, 3, 6))
            world.set_torque(tau)
            world.step()
            for _ in range(10):
                v = v + STEP_S / 10 * pin.aba(model, data, q, v, np.concatenate([np.zeros(6), tau]))
                q = pin.integrate(model, q, v * STEP_S / 10)
        there, speed = world.state()
    assert np.abs(v[6:]).max() > 1.0
    close = {"bullet": (1.5e-3, 0.08), "mujoco": (2.5e-4, 1e-4)}[engine]
    assert np.abs(pin.difference(model, q, there))[3:].max() < close[0] and np.abs(speed - v)[3:].max() < close[1]


@pytest.mark.parametrize("engine, mode", [*zip(INSTALLED, ("position", "pd"), strict=False)])
def test_a_jump_with_motors_lands(bhr, plan, engine, mode):
    """And the findings know armature and friction: of a robot without, the same log has unphysical torques."""
    run = simulate_jump(plan.tape, plan.robot, engine=engine, mode=mode)
    assert run.landed, run.reason
    assert [f.name for f in run.checks if not f.passed] == []
    assert run.metrics.com_rise_m == pytest.approx(0.2, abs=0.01)
    assert run.metrics.foot_distance_m == pytest.approx(0.4, abs=0.01)
    assert run.settings["engine"].get("late_armature", False) == (engine == "bullet")
    assert not {f.name: f for f in check(replace(run, robot=bhr))}["unexplained joint torque"].passed


# exported -----------------------------------------------------------------------------------------------------------
def test_exported(heavy, plan, tmp_path):
    folder = export.write("mujoco", Motion.of(plan.tape), heavy, tmp_path / "mujoco")
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    rows = [model.joint(name).dofadr[0] for name in heavy.joint_names]
    for key, own in zip(KEYS, (model.dof_armature, model.dof_frictionloss, model.dof_damping), strict=True):
        assert np.allclose(own[rows], getattr(heavy.limits, key)) and own[:6].max() == 0


# all together -------------------------------------------------------------------------------------------------------
def power_of(tape, used: float = 1.0) -> np.ndarray:
    """Power of all joints (N,) [W], with the share of braking that is used."""
    shaft = tape.tau * tape.v[:, 6:]
    return np.where(shaft > 0, shaft, used * shaft).sum(axis=1)


def with_bus(robot: Robot, told: str) -> Robot:
    return Robot(robot.urdf, f"{robot.config_text}\n[bus]\n{told}")


@pytest.mark.slow
@pytest.mark.parametrize("used", [1.0, 0.25])
def test_a_bus_that_gives_less_than_a_plan_asks_binds(plan, heavy, used):
    """The limit is below the free plan's peak; the plan with it comes near, and keeps it between the nodes too."""
    most = 0.8 * power_of(plan.tape, used).max()
    robot = with_bus(heavy, f"power_w = {most:.3f}\nregeneration = {used}\n")
    limited = Planner(robot).plan(plan.task)
    assert 0.9 * most < power_of(limited.tape, used).max() < most
    (check,) = (x for x in limited.audit.checks if x.name == "bus power")
    assert limited.audit.passed and check.value == pytest.approx(100 * power_of(limited.tape, used).max() / most)
    (check,) = (x for x in audit(plan.tape, robot, plan.task).failed if x.name == "bus power")
    assert check.value == pytest.approx(125.0, abs=1e-3)


def test_windings_that_warm_are_audited(plan, heavy):
    """A lower limit on the root mean square than the torque has fails by as much; losses add to the power."""
    tape = plan.tape
    k = heavy.joint_names.index("left_knee")
    mean = np.sqrt(np.trapezoid(tape.tau[:, k] ** 2, tape.t) / np.ptp(tape.t))
    drawn = power_of(tape) + 0.02 * tape.tau[:, k] ** 2
    told = f"power_w = {drawn.max():.9g}\nlosses.left_knee = 0.02\nrms.left_knee = {mean / 1.5:.9g}\n"
    checks = {x.name: x for x in audit(tape, with_bus(heavy, told), plan.task).checks}
    assert checks["torque over the motion"].value == pytest.approx(150.0, abs=1e-3)
    assert "left_knee" in checks["torque over the motion"].note
    assert checks["bus power"].value == pytest.approx(100.0, abs=1e-6)


@pytest.mark.parametrize("told, sentence", [
    ("power_w = -5", "[bus]: power_w = -5 W must be positive, and regeneration = 1 between 0 and 1"),
    ("regeneration = 1.5", "[bus]: power_w = inf W must be positive, and regeneration = 1.5 between 0 and 1"),
    ("losses.neck = 1.0",
     "[bus.losses]: neck = 1 must name a joint that moves, and be positive, at most inf"),
    ("rms.left_knee = 1e4",
     "[bus.rms]: left_knee = 10000 must name a joint that moves, and be positive, at most 210"),
])  # fmt: skip
def test_a_bus_that_cannot_be(bhr, told, sentence):
    assert refused(lambda: with_bus(bhr, told)) == f"robot bhr: {sentence}"
