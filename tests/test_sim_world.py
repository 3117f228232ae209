"""Every engine against what must be true of any world."""

import sys
from dataclasses import fields, replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import planner, refused

from jumplab import sim
from jumplab.control.kinematics import Gauge
from jumplab.control.playback import AIR, FLAT, Command
from jumplab.control.servo import WholeBodyServo
from jumplab.errors import InputError, JumplabError, RobotError
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration
from jumplab.sim import INSTALLED, STEP_S, Perturbation, Ranges, Scene, SensorNoise, engine_class, simulate_jump
from jumplab.sim import engine as engines
from jumplab.sim.motors import Motors
from jumplab.task import JumpTask

with_bullet = pytest.mark.skipif("bullet" not in INSTALLED, reason="PyBullet is not installed")


@pytest.fixture(params=INSTALLED)
def engine(request):
    """Each engine in turn."""
    return engine_class(request.param)


class Hold:
    """Keeps the joints of a robot where they are in ``q``, by the servo law."""

    def __init__(self, robot, q, feet=FLAT):
        still = np.zeros(len(q) - 7)
        self.servo, self.motors = WholeBodyServo(robot), Motors(robot, {})
        self.command = Command(q=q[7:], rate=still, acceleration=still, feet=feet)

    def step(self, world):
        q, v = world.state()
        world.set_torque(self.motors.deliver(self.servo.torque(self.command, q, v), v[6:]))
        world.step()


def random_state(robot, seed, height=3.0):
    rng = np.random.default_rng(seed)
    lower, upper = robot.model.lowerPositionLimit[7:], robot.model.upperPositionLimit[7:]
    q = pin.neutral(robot.model)
    q[:3] = rng.normal(size=3) + np.array([0, 0, height])
    q[3:7] = pin.Quaternion(pin.exp3(rng.normal(size=3))).coeffs()
    q[7:] = lower + (upper - lower) * rng.uniform(0.4, 0.6, len(lower))  # far from the stops
    return q, rng.normal(size=robot.model.nv)


def momentum(robot, q, v):
    now = Gauge(robot).motion(q, v)
    return now.com, robot.total_mass * now.velocity, now.momentum


@with_bullet
def test_base_conversion_by_hand():
    """A base turned by 90 degrees about y, spinning about z in the world, CoM 0.2 m below the link's origin."""
    half = np.sqrt(0.5)
    q, v = np.array([1, 2, 3, 0, half, 0, half]), np.array([0, 0, 0, -5, 0, 0])  # local x is world -z
    position, _, velocity, rate = sim.base_to_bullet(q, v, np.array([0, 0, -0.2]))
    assert position == pytest.approx([0.8, 2, 3])
    assert rate == pytest.approx([0, 0, 5])
    assert velocity == pytest.approx([0, -1, 0])


def test_a_state_is_that_of_now_and_belongs_to_who_asked(engine, bhr):
    """Asked twice it is the same, whatever became of the first answer; after a step it is another one."""
    q = stance_configuration(bhr)
    q[2] += 1.0
    with engine(bhr, q) as world:
        first, at_rest = world.state()
        kept = first.copy()
        first[:], at_rest[:] = 0.0, 1.0
        again, still = world.state()
        assert again.tolist() == kept.tolist() and not still.any()
        world.step()
        assert world.state()[1][2] < -0.009  # falls


def test_free_flight_conserves_momentum(engine, bhr):
    """No damping anywhere: the CoM falls as a stone does, L stays. Bullet's default damping would eat 3 % of L."""
    q, v = random_state(bhr, 0)
    com, linear, angular = momentum(bhr, q, v)
    steps = 300
    with engine(bhr, q, v) as world:
        back_q, back_v = world.state()
        assert back_q == pytest.approx(q, abs=1e-12) and back_v == pytest.approx(v, abs=1e-12)
        for _ in range(steps):
            world.step()
        assert not world.log().touching.any()
        end_com, end_linear, end_angular = momentum(bhr, *world.state())
    t = steps * STEP_S
    assert end_linear[:2] == pytest.approx(linear[:2], abs=0.1)  # of 42 kg at about 1 m/s
    assert end_linear[2] - linear[2] == pytest.approx(-42 * 9.8 * t, abs=0.1)
    assert end_angular == pytest.approx(angular, abs=0.02 * max(1, np.abs(angular).max()))
    semi_implicit = -9.8 * t * STEP_S / engine.known["hard"].substeps / 2  # the engine's own error of a free fall
    fall = linear[2] / 42 * t - 9.8 * t**2 / 2 + semi_implicit
    assert end_com[2] - com[2] == pytest.approx(fall, abs=1e-3)


def test_a_body_without_mass_is_refused(bhr):
    """A dummy link without <inertial> weighs nothing to Pinocchio and 1 kg to PyBullet, and MuJoCo will not have it."""
    first = bhr.urdf.index("<inertial>", bhr.urdf.index('name="left_ankle_link"'))
    last = bhr.urdf.index("</inertial>", first) + len("</inertial>")
    robot = Robot(bhr.urdf[:first] + bhr.urdf[last:], bhr.config_text)
    if "bullet" in INSTALLED:
        with pytest.raises(JumplabError, match=r"PyBullet's robot weighs 42\.9990 kg, Pinocchio's 41\.9990 kg"):
            engine_class("bullet")(robot, pin.neutral(robot.model))
    with pytest.raises(RobotError, match=r"^robot bhr: MuJoCo cannot read the URDF: .*mass and inertia"):
        engine_class("mujoco")(robot, pin.neutral(robot.model))


def test_unknown_engines_are_refused():
    for name in ("ode", "", None, 3):
        with pytest.raises(InputError, match=rf"^engine .*: must be one of {', '.join(INSTALLED)}$"):
            engine_class(name)


BULLET_CURE = "pip install pybullet on Python 3.11, pybullet-arm64 on 3.12 and 3.13 (it is built for no later one)"


@pytest.mark.parametrize(
    ("engine", "package", "cure"),
    [
        ("mujoco", "mujoco", "take 'bullet', or pip install mujoco"),
        ("bullet", "pybullet", f"take 'mujoco', or {BULLET_CURE}"),
    ],
)
def test_an_engine_that_is_not_installed_says_what_to_install(monkeypatch, engine, package, cure):
    monkeypatch.setattr(engines, "INSTALLED", ("bullet", "mujoco"))
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"jumplab.sim.{engine}", raising=False)
    assert refused(engine_class, engine) == f"engine {engine!r}: the package {package} is not installed; {cure}"


@pytest.mark.parametrize("friction", [0.37, 0.8])
def test_friction_reaches_every_link(engine, bhr, friction):
    with engine(bhr, stance_configuration(bhr), friction=friction) as world:
        assert set(world.kept().friction) >= {"trunk", "left_foot", "right_foot", "left_arm"}
        assert set(world.kept().friction.values()) == {friction}


def test_friction_that_did_not_arrive_is_refused(bhr, monkeypatch):
    """PyBullet ignores friction in a call that also sets damping; the read-back must notice."""
    bullet = pytest.importorskip("pybullet")
    real = bullet.changeDynamics

    def lossy(body, link, **settings):
        if link >= 0:
            settings.pop("lateralFriction", None)
        real(body, link, **settings)

    monkeypatch.setattr(bullet, "changeDynamics", lossy)
    with pytest.raises(JumplabError, match=r"PyBullet has friction 0\.5 on \w+, but 0\.83 was set"):
        engine_class("bullet")(bhr, stance_configuration(bhr), friction=0.83)


def test_sliding_feet_are_braked_by_friction(engine, bhr):
    """Against their motion, with the stated share of what presses on them."""
    q, v = stance_configuration(bhr), np.zeros(bhr.model.nv)
    pitch = bhr.stance["trunk_pitch_rad"]
    v[[0, 2]] = 0.3 * np.cos(pitch), 0.3 * np.sin(pitch)  # 0.3 m/s forward, in base axes
    hold, gauge = Hold(bhr, q, AIR), Gauge(bhr)
    for friction in (0.06, 0.12):
        impulse = np.zeros(3)
        with engine(bhr, q, v, friction=friction) as world:
            for _ in range(12):
                hold.step(world)
                impulse += STEP_S * world.wrench().sum(axis=0)[:3]
            speed = gauge.soles(world.state()[0])[0] / (12 * STEP_S)
        assert speed > 0.1 and impulse[2] > 0.5 * 42 * 9.8 * 12 * STEP_S
        assert -impulse[0] == pytest.approx(friction * impulse[2], rel=0.02)


def test_foot_sensors_weigh_the_robot(engine, bhr):
    """In a quiet stance: m g, no net horizontal force, CoP below the CoM; only feet touch, nothing collides."""
    q = stance_configuration(bhr)
    hold = Hold(bhr, q)
    with engine(bhr, q) as world:
        for _ in range(1000):
            hold.step(world)
        log, wrench, (end, v) = world.log(), world.wrench(), world.state()
    total = wrench.sum(axis=0)
    assert total[:3] == pytest.approx([0, 0, 42 * 9.8], abs=0.05)
    assert set(np.array(world.links)[log.touching[-1]]) == {"left_foot", "right_foot"} and not log.colliding.any()
    assert np.abs(end - q).max() < 1e-3
    feet = [place.translation for place in Gauge(bhr).places(end)]
    moment = sum(w[3:] + np.cross(p, w[:3]) for p, w in zip(feet, wrench, strict=True))
    com = momentum(bhr, end, v)[0]
    assert -moment[1] / total[2] == pytest.approx(com[0], abs=1e-3)
    assert moment[0] / total[2] == pytest.approx(com[1], abs=1e-3)


@pytest.fixture(scope="module")
def front_flip():
    return planner().plan(JumpTask(0.0, 0.5, rotation_rad=2 * np.pi)).tape


def test_a_toe_that_pushes_off_stays_on_the_ground(engine, bhr, front_flip):
    """Turning legs pull at the contact (J' v): the ground must neither let go of a loaded toe nor give way to it."""
    tape, toe = front_flip, Gauge(bhr).toe
    run, takeoff = simulate_jump(tape, bhr, mode="pd", engine=engine.name, stand_s=0.01), round(1e3 * tape.takeoff_time)
    late = np.arange(takeoff - 150, takeoff - 5)
    push = run.foot_wrench[late, :, 2].sum(axis=1)
    planned = np.interp(late * 1e-3, tape.t[: tape.takeoff_index], tape.f[: tape.takeoff_index, :, 2].sum(axis=1))
    assert planned.max() > 3 * 42 * 9.8 and np.abs(push - planned).max() < 0.05 * 42 * 9.8
    creep_m_s = abs(toe(run.q[takeoff - 5])[0] - toe(run.q[0])[0]) / (tape.takeoff_time - tape.extra["toe_phase_start"])
    assert creep_m_s < 3e-3  # engines' friction gives way slowly; a toe that slips is faster by far
    assert run.metrics.takeoff_momentum == pytest.approx(tape.extra["planar_L"][tape.takeoff_index], abs=0.15)


def test_contact_impulse_is_change_of_momentum(engine, bhr):
    """Sliding down onto the ground: every step the measured forces explain the change of momentum, sign and size."""
    q, v = stance_configuration(bhr), np.zeros(bhr.model.nv)
    q[2] += 0.002
    v[0], v[2] = 0.5, -0.5
    hold = Hold(bhr, q)
    impulse, start = np.zeros(3), momentum(bhr, q, v)[1]
    with engine(bhr, q, v) as world:
        for _ in range(60):
            hold.step(world)
            impulse += STEP_S * (world.wrench().sum(axis=0)[:3] - [0, 0, 42 * 9.8])
        change = momentum(bhr, *world.state())[1] - start
    assert abs(impulse[0]) > 3
    assert impulse == pytest.approx(change, abs=0.3)


def test_sagittal_postures_never_collide_but_crossed_legs_do(engine, bhr):
    """Self-collision is on, without exclusions beyond direct neighbours: the ranges of the joints are real."""
    rng, names = np.random.default_rng(0), bhr.joint_names
    role = {name: role for role, pair in bhr.joints.items() for name in pair}
    for k in range(8):
        share = dict(zip(bhr.joints, rng.integers(0, 2, 4) if k < 4 else rng.uniform(size=4), strict=True))
        q = pin.neutral(bhr.model)
        q[2] = 3.0
        for i, name in enumerate(names):
            if name in role:
                limits = bhr.actuators[name]
                q[7 + i] = limits["lower"] + share[role[name]] * (limits["upper"] - limits["lower"])
        with engine(bhr, q) as world:
            world.step()
            assert not world.log().colliding[-1]
    q = pin.neutral(bhr.model)
    q[2] = 3.0
    q[7 + names.index("left_hip_roll")], q[7 + names.index("right_hip_roll")] = -0.2, 0.2
    with engine(bhr, q) as world:
        world.step()
        assert world.log().colliding[-1]


def test_scenes_have_real_edges(engine, bhr):
    """Over the ditch the robot falls to its floor, on the platform it stands on the platform."""
    ditch, platform = Scene.level("ditch", {0.3: -0.5, 1.3: 0.0}), Scene.level("platform", {0.4: 0.3})
    assert [ditch.top_at(x) for x in (0, 0.8, 1.5)] == [0, -0.5, 0]
    assert [platform.top_at(x) for x in (0, 1)] == [0, 0.3]
    hold = Hold(bhr, stance_configuration(bhr), AIR)
    for scene, x, z, end in ((ditch, 0.8, 0.0, -0.5), (platform, 0.8, 0.3, 0.3), (platform, 0.0, 0.0, 0.0)):
        q = stance_configuration(bhr)
        height = q[2]
        q[:3] += [x, 0, z]
        with engine(bhr, q, scene=scene) as world:
            for _ in range(600):
                hold.step(world)
            assert world.state()[0][2] == pytest.approx(height + end, abs=0.02)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Scene.level("ditch", {-0.1: -1.0, 1.0: 0.0}), "ditch at -0.1, 1 m: its places must be ahead"),
        (lambda: Scene.level("stairs", {0.5: 0.1, 0.4: 0.2}), "stairs at 0.5, 0.4 m: its places must be ahead"),
        (lambda: Perturbation(friction=0.0), "friction = 0 is outside 0 ... 2"),
        (lambda: Perturbation(delay_s=0.1), "^delay = 0.1 s is outside 0 ... 0.02 s$"),
        (lambda: Perturbation(known_delay_s=-0.001), "^known delay = -0.001 s is outside 0 ... 0.02 s$"),
    ],
)
def test_impossible_worlds_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_perturbations_are_seeded_and_bounded(engine, bhr):
    one, same, other = (Perturbation.draw(bhr, seed) for seed in (7, 7, 8))
    assert one == same and one != other
    assert len(one.mass) == 9  # the massless dummies are left alone
    assert all(abs(f - 1) <= 0.05 for f in one.mass.values())
    assert all(abs(f - 1) <= 0.10 for f in one.inertia.values())
    assert all(abs(x) <= 0.015 for shift in one.com.values() for x in shift)
    assert 0.5 <= one.friction <= 1.0 and 0 <= one.delay_s <= 0.004 and one.known_delay_s == 0.002
    real = one.robot(bhr)
    model, planned = real.model, bhr.model
    knee = model.getJointId("left_knee")
    assert model.inertias[knee].mass == pytest.approx(planned.inertias[knee].mass * one.mass["left_shank"])
    assert model.inertias[knee].lever == pytest.approx(planned.inertias[knee].lever + one.com["left_shank"])
    factor = one.mass["left_shank"] * one.inertia["left_shank"]
    assert model.inertias[knee].inertia == pytest.approx(planned.inertias[knee].inertia * factor)
    assert Perturbation().robot(bhr) is bhr
    with engine(real, stance_configuration(bhr), friction=one.friction) as world:  # checks its mass against Pinocchio
        assert set(world.kept().friction.values()) == {one.friction}


def test_ranges_and_sensors_say_what_they_are():
    """Every number, changed, changes the sentence."""
    said = (
        "masses ±5 %, centres of mass ±15 mm per axis, inertias ±10 %, motors ±5 %, friction 0.5 ... 1, "
        "commands 0 ... 4 ms late and sent 2 ms ahead"
    )
    assert str(Ranges()) == said and str(SensorNoise()) == "the true state and foot forces"
    for name, value in vars(SensorNoise.typical()).items():
        assert str(replace(SensorNoise.typical(), **{name: 2 * value})) != str(SensorNoise.typical()), name
    for f in fields(Ranges):
        least, most = f.metadata["least"], f.metadata["most"]
        other = (least, (least + most) / 3) if isinstance(f.default, tuple) else (f.default + most) / 2
        assert str(Ranges(**{f.name: other})) != str(Ranges()), f.name
    further = Ranges(payload_kg=(1, 3), ground_m=0.02, sensors=(1, 4), sag_per_kw=(0, 0.02))
    assert str(further) == (
        f"{said}, a payload in the trunk's box of 1 ... 3 kg, speed limits lost to the battery 0 ... 2 %/kW, "
        "the ground of the landing higher by ±20 mm, sensor errors times 1 ... 4"
    )


def test_read_back_is_what_the_engine_has(engine, bhr):
    """Gravity is the robot's own; inertias are compared with its own, turned and shifted ones included."""
    start = stance_configuration(bhr)
    with engine(bhr, start, scene=Scene.level("platform", {0.5: 0.2}), friction=0.7) as world:
        said, (q, v) = world.read_back(), world.state()
    assert said["friction"] == [pytest.approx(0.7)] and said["self_collision"] and said["beyond_sole_m"] == 0
    assert said["mass_kg"] == pytest.approx(42) and said["damping"] == 0 and said["name"] == engine.name
    assert said["gravity"] == [0, 0, -9.8] and said["inertia_error"] < 1e-12
    assert q == pytest.approx(start, abs=1e-12) and not v.any()  # the probe of the self-collision left nothing behind
    with engine(Perturbation.draw(bhr, 3).robot(bhr).under_gravity(1.62), start) as world:
        said, has = world.read_back(), world.kept().inertials
    assert said["gravity"] == [0, 0, -1.62] and said["inertia_error"] < 1e-12
    planned = bhr.model.inertias[bhr.model.getJointId("left_knee")]
    assert np.abs(has["left_shank"].inertia - planned.inertia).max() > 1e-4  # it is the other one's


def test_usual_contacts_are_the_defaults_of_each_engine(bhr):
    """Those of a model that says nothing by MuJoCo's own parser; those of PyBullet in a world that was told nothing."""
    mujoco, bullet = (pytest.importorskip(name) for name in ("mujoco", "pybullet"))
    plain = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    known = engine_class("mujoco").known["usual"]
    assert [known.time_s, known.damping_ratio] == plain.geom_solref[0].tolist()
    assert [*known.impedance, known.depth_m] == plain.geom_solimp[0, :3].tolist()
    assert known.elliptic == bool(plain.opt.cone) and known.cone_ratio == plain.opt.impratio
    client = bullet.connect(bullet.DIRECT)
    said = bullet.getPhysicsEngineParameters(client)
    with engine_class("bullet")(bhr, stance_configuration(bhr), contact="usual"):
        told = bullet.getPhysicsEngineParameters(client + 1)
    with engine_class("bullet")(bhr, stance_configuration(bhr)):
        hard = bullet.getPhysicsEngineParameters(client + 1)
    bullet.disconnect(client)
    assert told["numSolverIterations"] == said["numSolverIterations"] < hard["numSolverIterations"]
