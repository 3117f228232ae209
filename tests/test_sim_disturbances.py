"""Disturbances: what is drawn, refused and put into a run; scenes; and why jumps fail."""

import hashlib
import json
from dataclasses import asdict, fields, replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import refused
from test_sim_world import Hold, momentum
from test_sim_world import engine as engine

from jumplab import sim
from jumplab.cli.common import disturbances
from jumplab.control.kinematics import Gauge
from jumplab.robot.stance import stance_configuration
from jumplab.sim import (
    CONTACTS,
    INSTALLED,
    STEP_S,
    Perturbation,
    Ranges,
    Scene,
    SensorNoise,
    Shove,
    Sign,
    ranges_of,
    signs,
)
from jumplab.sim.checks import check
from jumplab.sim.motors import Motors
from jumplab.sim.perturbation import Push
from jumplab.sim.scene import REACH_M, Block

OLD = ("seed", "mass", "inertia", "com", "friction", "delay_s", "known_delay_s", "motor_gain", "noise")
FORCE_N = np.array([30.0, -20.0, 10.0])


def test_a_negative_seed_is_refused(bhr):
    assert refused(Perturbation.draw, bhr, -3) == "seed = -3 must not be negative"


def test_the_robots_of_the_usual_ranges_stay_the_same(bhr):
    """Further disturbances are drawn from a stream of their own, and change no number of those before."""
    drawn = [Perturbation.draw(bhr, seed, noise=SensorNoise.typical()).to_json() for seed in range(20)]
    rows = json.dumps([{name: row[name] for name in OLD} for row in drawn], sort_keys=True)
    known = "fb24b5bdc85a7886e85d2b2f72fabbd2c0d9ae30dad53cc8ceb4f473448b9eab"
    assert hashlib.sha256(rows.encode()).hexdigest() == known
    nothing = Perturbation().to_json()
    assert all(row[name] == nothing[name] for row in drawn for name in row if name not in OLD)
    wide = Perturbation.draw(bhr, 3, Ranges(payload_kg=(0, 5), shove_flight_n_s=(5, 25))).to_json()
    wider = Perturbation.draw(bhr, 3, Ranges(payload_kg=(0, 5), shove_flight_n_s=(5, 25), soft_m=(0, 0.02))).to_json()
    assert {name for name in wide if wide[name] != wider[name]} == {"soft_m"}
    assert {name: wide[name] for name in OLD if name != "noise"} == {n: drawn[3][n] for n in OLD if n != "noise"}


def test_draws_stay_within_their_ranges(bhr):
    most = {f.name: (f.metadata["least"], f.metadata["most"]) if isinstance(f.default, tuple) else f.metadata["most"]
            for f in fields(Ranges)}  # fmt: skip
    drawn = [Perturbation.draw(bhr, seed, Ranges(**most), SensorNoise.typical()) for seed in range(12)]
    low, high = np.array([-0.08, -0.14, -0.33]), np.array([0.08, 0.14, 0.0])
    for one in drawn:
        assert 0 <= one.payload_kg <= 5 and all(0 <= x <= 0.2 for x in one.torque_loss.values())
        assert all(0 <= x <= 0.1 for x in one.speed_loss.values()) and 0 <= one.sag_per_kw <= 0.05
        assert abs(one.ground_m) <= 0.04 and max(map(abs, one.ground_tilt_rad)) <= np.radians(4)
        assert [s.phase for s in one.shoves] == ["launch", "flight", "landing"] and 0 <= one.soft_m <= 0.03
        assert all(0 <= s.impulse_n_s <= 25 and 0 <= s.share <= 1 for s in one.shoves)
        assert all(abs(x) <= np.radians(3) for x in one.posture_rad.values())
        assert all(0 <= x <= 0.05 for x in one.armature.values()) and all(0 <= x <= 3 for x in one.damping.values())
        assert 0 <= one.noise.gyro <= 4 * SensorNoise.typical().gyro
        assert (np.array(one.payload_m)[:2] >= low[:2]).all() and (np.array(one.payload_m)[:2] <= high[:2]).all()
    assert len({one.payload_m for one in drawn}) == 12 and max(one.payload_kg for one in drawn) > 4


@pytest.mark.parametrize(
    ("ranges", "sentence"),
    [
        (dict(payload_kg=(0, 6)), "the range payload_kg = 0 ... 6 is outside 0 ... 5; choose a smaller one"),
        (dict(friction=(0.2, 1.0)), "the range friction = 0.2 ... 1 is outside 0.3 ... 1; choose a smaller one"),
        (dict(soft_m=(0.02, 0.01)), "the range soft_m = 0.02 ... 0.01 is outside 0 ... 0.03; choose a smaller one"),
        (dict(ground_m=0.05), "the range ground_m = 0.05 is outside 0 ... 0.04; choose a smaller one"),
        (dict(mass=float("nan")), "the range mass = nan is outside 0 ... 0.2; choose a smaller one"),
        (dict(delay_s=0.004), "the range delay_s must be two numbers, from and to, got 0.004"),
        (dict(mass=(0.0, 0.1)), "the range mass must be one number, a half-width, got (0.0, 0.1)"),
    ],
)
def test_ranges_beyond_what_is_documented_are_refused(ranges, sentence):
    assert refused(Ranges, **ranges) == sentence


def test_disturbances_as_they_are_typed():
    told = disturbances("--disturb", ["payload_kg=5", "friction=0.3:1.0", "ground_m=0.02", "delay_s=0.008"])
    ranges = ranges_of(told)
    assert (ranges.payload_kg, ranges.friction, ranges.ground_m) == ((0, 5), (0.3, 1.0), 0.02)
    assert ranges.delay_s == (0, 0.008) and ranges.mass == 0 and ranges_of({}, Ranges()) == Ranges()
    assert ranges_of({"friction": (0.4,)}).friction == (0.4, 0.8) and ranges_of({"sensors": (3,)}).sensors == (1, 3)
    for pairs, words in ((["wind=3"], "no disturbance is called 'wind'; there are mass, com_m, "),
                         (["mass=0:1"], "the range mass must be one number, a half-width, got (0.0, 1.0)"),
                         (["mass"], "--disturb must be NAME=SIZE or NAME=FROM:TO, got 'mass'"),
                         (["mass=x"], "--disturb mass must be a number, got 'x'")):  # fmt: skip
        assert refused(lambda pairs=pairs: ranges_of(disturbances("--disturb", pairs))).startswith(words)


def test_a_payload_is_a_cube_fixed_to_the_trunk(engine, bhr):
    place = np.array([0.05, -0.1, -0.2])
    real = Perturbation(payload_kg=4.0, payload_m=tuple(place.tolist())).robot(bhr)
    one, other = bhr.model.inertias[1], real.model.inertias[1]
    assert real.total_mass == pytest.approx(bhr.total_mass + 4)
    assert other.lever * other.mass == pytest.approx(one.lever * one.mass + 4 * place)
    cube = pin.Inertia(4.0, place, 4 * 0.1**2 / 6 * np.eye(3))
    assert other.toDynamicParameters() == pytest.approx((one + cube).toDynamicParameters())
    with engine(real, stance_configuration(bhr)) as world:
        assert world.kept().mass_kg == pytest.approx(bhr.total_mass + 4) and world.read_back()["inertia_error"] < 1e-9


@pytest.mark.parametrize("name", INSTALLED)
def test_rotors_and_damping_beside_the_planned_ones_are_felt(bhr, name, tape):
    ranges = Ranges.none(rotor_kg_m2=(0.02, 0.02), damping_n_m_s=(1.0, 1.0))
    assert str(ranges).endswith("rotors heavier by 0.02 ... 0.02 kg m^2, joints damped more by 1 ... 1 N m s/rad")
    drawn = Perturbation.draw(bhr, 4, ranges)
    real = drawn.robot(bhr)
    for key, more in (("armature", 0.02), ("damping", 1.0)):
        assert getattr(real.limits, key) == pytest.approx(getattr(bhr.limits, key) + more, abs=1e-15)
    assert real.total_mass == pytest.approx(bhr.total_mass, abs=1e-9)
    run = sim.simulate_jump(tape, bhr, perturbation=drawn, engine=name, stand_s=0.1)
    assert run.checks_passed, [str(f) for f in run.checks if not f.passed]
    assert run.robot.limits.damping == pytest.approx(real.limits.damping)


def test_weak_motors_and_an_empty_battery_shrink_the_limit_curve(bhr):
    knee = bhr.joint_names.index("left_knee")
    real = Perturbation(torque_loss={"left_knee": 0.2}, speed_loss={"left_knee": 0.1}).robot(bhr)
    had, has = bhr.actuators["left_knee"], real.actuators["left_knee"]
    shares = {"effort": 0.8, "speed": 0.9, "corner_speed": 0.9, "lower": 1.0, "upper": 1.0}
    assert all(has[name] == pytest.approx(share * had[name]) for name, share in shares.items())
    assert real.actuators["right_knee"] == bhr.actuators["right_knee"]
    weak, rate, tau = Motors(bhr, {}, sag_per_kw=0.05), np.zeros(14), np.zeros(14)
    rate[knee], tau[knee] = 0.75 * had["speed"], 1e4
    full = weak.deliver(tau, rate)[knee]  # nothing was drawn before
    assert full == pytest.approx(had["effort"] / 2)
    left = 1 - 0.05 * full * rate[knee] / 1e3
    assert weak.deliver(tau, rate)[knee] == pytest.approx(had["effort"] * (had["speed"] - rate[knee] / left)
                                                          / (had["speed"] - had["corner_speed"]))  # fmt: skip
    weak.deliver(-tau, rate)  # braking draws nothing
    assert weak.deliver(tau, rate)[knee] == pytest.approx(full)


def test_a_wrong_posture_leaves_the_soles_where_they_stand(bhr):
    q = stance_configuration(bhr)
    wrong = Perturbation.draw(bhr, 2, ranges_of({"posture_deg": (3.0,)})).start(bhr, q)
    off = np.degrees(wrong[7:] - q[7:])
    assert 1.0 < np.abs(off).max() < 6.0
    for was, there in zip(Gauge(bhr).places(q), Gauge(bhr).places(wrong), strict=True):
        assert pin.log6(was.actInv(there)).vector == pytest.approx(np.zeros(6), abs=1e-9)
    assert Perturbation().start(bhr, q) is q


def test_a_push_gives_its_impulse_and_its_moment(engine, bhr):
    q, place = stance_configuration(bhr), np.array([0.1, 0.05, -0.2])
    q[2] += 3
    with engine(bhr, q) as world:
        world.push(FORCE_N, place)
        world.step()
        com, linear, angular = momentum(bhr, *world.state())
        world.step()
        after = momentum(bhr, *world.state())[1]
    attitude = pin.Quaternion(q[6], *q[3:6]).toRotationMatrix()
    weight = np.array([0, 0, -42 * 9.8])
    assert linear == pytest.approx((FORCE_N + weight) * STEP_S, abs=1e-6)
    assert angular == pytest.approx(np.cross(q[:3] + attitude @ place - com, FORCE_N) * STEP_S, abs=1e-6)
    assert after - linear == pytest.approx(weight * STEP_S, abs=1e-6)  # it lasts one step


def test_ground_gives_way_by_what_was_said(engine, bhr):
    q, soft_m = stance_configuration(bhr), 0.01
    scene = Scene("soft", (replace(Scene.flat().blocks[0], soft_m=soft_m),))
    hold, start = Hold(bhr, q), scene.seated(bhr, q)
    assert start[2] == pytest.approx(q[2] - soft_m)
    with engine(bhr, start, scene=scene, friction=0.7) as world:
        for _ in range(400):
            hold.step(world)
        sink, wrench = q[2] - world.state()[0][2], world.wrench()
        assert world.read_back()["friction"] == [pytest.approx(0.7)]
    assert sink == pytest.approx(soft_m, rel=0.1)  # so that engines are within 20 % of each other
    assert wrench[:, 2].sum() == pytest.approx(42 * 9.8, rel=0.02)


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("soft_m", [1e-5, 1e-4, 1e-3])
def test_soft_ground_throws_nobody_up(engine, bhr, soft_m, contact):
    q = stance_configuration(bhr)
    scene = Scene("soft", (replace(Scene.flat().blocks[0], soft_m=soft_m),))
    hold, start = Hold(bhr, q), scene.seated(bhr, q)
    start[2] += 0.02
    with engine(bhr, start, scene=scene, contact=contact) as world:
        heights = []
        for _ in range(300):
            hold.step(world)
            heights.append(world.state()[0][2])
    assert max(heights) < start[2] + 1e-3 and q[2] - 0.002 < heights[-1] < q[2]


def test_a_shove_is_timed_by_the_plan_and_known_to_the_checks(bhr, tape):
    end, takeoff = float(tape.t[-1]), tape.takeoff_time
    shoves = tuple(Shove(phase, 1.0, 15.0, np.pi / 2) for phase in ("launch", "flight", "landing"))
    found = Perturbation(shoves=shoves).pushes(tape)
    assert [p.step * STEP_S for p in found] == pytest.approx([x - 0.05 for x in (takeoff, end, end + 1)], abs=STEP_S)
    assert all(p.steps == 50 and p.force_n == pytest.approx((0, 300, 0)) for p in found)
    assert [Push(3, 2, (0.0, 0.0, 0.0)).at(k) for k in range(2, 6)] == [False, True, True, False]
    said = refused(Perturbation(shoves=shoves).pushes, None)
    assert said == "a shove, and other ground for the landing, are for a single jump; leave them out of a chain"


@pytest.mark.parametrize("name", INSTALLED)
def test_a_disturbed_run_passes_and_a_hidden_shove_does_not(bhr, name, tape):
    """Everything at once; the momentum in the log is that of gravity, ground and shove, for which the log says so."""
    told = dict(payload_kg=(3, 3), torque_loss=(0.1, 0.1), sag_per_kw=(0.02, 0.02), ground_m=0.02, ground_tilt_deg=2,
                soft_m=(0.003, 0.003), shove_flight_n_s=(8, 8), posture_deg=1)  # fmt: skip
    drawn = Perturbation.draw(bhr, 5, Ranges.none(**told), SensorNoise.typical())
    run = sim.simulate_jump(tape, bhr, perturbation=drawn, engine=name, stand_s=0.1)
    assert run.checks_passed, [str(f) for f in run.checks if not f.passed]
    assert run.settings["perception"]["state"] == "estimated" and run.link_names[-1] == "payload"
    (push,) = run.settings["pushes"]
    at, mass = slice(push["step"], push["step"] + 50), run.robot.total_mass
    gained = mass * (run.com_velocity[at.stop] - run.com_velocity[at.start])[:2]
    ground = run.foot_wrench[at, :, :2].sum(axis=(0, 1)) * STEP_S
    assert gained - ground == pytest.approx(0.05 * np.array(push["force_n"][:2]), abs=0.2)
    assert np.hypot(*push["force_n"][:2]) * 0.05 == pytest.approx(8.0)
    hidden = replace(run, settings=run.settings | {"pushes": []})
    assert "unexplained force on the body" in {f.name for f in check(hidden) if not f.passed}


def test_the_landing_is_moved_and_the_start_is_not(bhr, tape):
    ground = Perturbation(ground_m=0.03, ground_tilt_rad=(0.05, -0.03)).ground(Scene.flat(), bhr, tape)
    end = Gauge(bhr).soles(tape.q[-1])
    assert ground.top_at(0.0) == ground.top_at(0.1, 0.5) == 0
    assert ground.top_at(end[0]) == pytest.approx(0.03, abs=2e-3)
    slope = (ground.top_at(end[0] + 0.1) - ground.top_at(end[0])) / 0.1
    assert slope == pytest.approx(-np.tan(0.05), rel=1e-3)  # a positive pitch goes downhill
    assert (ground.top_at(end[0], 0.1) - ground.top_at(end[0])) / 0.1 == pytest.approx(-0.03, rel=0.01)
    short = replace(tape, q=np.vstack([tape.q[:-1], tape.q[:1]]))
    assert refused(Perturbation(ground_m=0.03).ground, Scene.flat(), bhr, short) == (
        "the soles land 0.00 m from where they start, so ground_* would also change the ground of the start; "
        "jump farther, or leave out ground_*"
    )


def slope(pitch_rad, roll_rad=0.0):
    return Scene("slope", (Block(-REACH_M, REACH_M, pitch_rad=pitch_rad, roll_rad=roll_rad),))


def test_scenes_are_what_they_say(engine, bhr):
    stairs = Scene.level("stairs", {0.3: 0.1, 0.55: 0.2, 0.8: 0.3})
    assert [stairs.top_at(x) for x in (0, 0.4, 0.6, 0.9)] == [0, 0.1, 0.2, 0.3]
    assert slope(0.1).top_at(1.0) == pytest.approx(-np.tan(0.1))
    stone = Block(0.4, 0.5, 0.02, y_from=0.05, y_to=0.15)
    gravel = Scene("gravel", (*Scene.flat().blocks, stone))
    assert [gravel.top_at(0.45, y) for y in (0.0, 0.1)] == [0, 0.02] and gravel.top_at(0.2) == 0
    for scene in (gravel, slope(0.05, 0.03)):
        start = scene.seated(bhr, stance_configuration(bhr))
        with engine(bhr, start, scene=scene) as world:
            hold = Hold(bhr, start)
            for _ in range(30):
                hold.step(world)
            assert set(np.array(world.links)[world.log().touching[-1]]) == {"left_foot", "right_foot"}
            assert world.wrench()[:, 2].sum() == pytest.approx(42 * 9.8, rel=0.1)


def test_boxes_lie_where_the_heights_are():
    """The corners of a turned box' top are on its plane, whatever the direction of the jump."""
    block = Block(0.5, 1.5, 0.2, y_from=-0.4, y_to=0.6, pitch_rad=0.1, roll_rad=-0.2, pivot_m=0.8)
    scene = Scene("one", (block,), along_rad=0.7)
    ((half, centre, turn),) = scene.boxes()
    axes = pin.Quaternion(turn[3], *turn[:3]).toRotationMatrix()
    for sign in ((1, 1, 1), (1, -1, 1), (-1, -1, 1)):
        corner = centre + axes @ (half * sign)
        assert corner[2] == pytest.approx(block.height_at(*scene.along(corner)), abs=1e-12)
    cut = scene.within(0.7, 3.0, 0.3).blocks[0]
    assert (cut.x_from, cut.x_to, cut.y_from, cut.y_to, cut.pivot_m) == (0.7, 1.5, -0.3, 0.3, 0.8)


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (slope(0.3), "its CoM is"),
        (Scene.level("stairs", {0.05: 0.1}),
         "a corner of its soles is -100 mm above the ground, at most 5; let the ground be even around x = 0, at z = 0"),
        (Scene("none", ()), f"a corner of its soles is +{1e3 * REACH_M:.0f} mm above the ground, at most 5; let"),
    ],
)  # fmt: skip
def test_a_scene_that_the_robot_cannot_stand_on_is_refused(bhr, scene, sentence, tape):
    said = refused(sim.simulate_jump, tape, bhr, scene=scene)
    assert said.startswith(f"scene {scene.name}: the robot cannot stand on it at the start, {sentence}")


@pytest.fixture(scope="module")
def fall(bhr, tape):
    """A real one: a shove of 60 N s to the side while it lands."""
    drawn = Perturbation(shoves=(Shove("landing", 0.0, 60.0, np.pi / 2),), friction=1.0)
    return sim.simulate_jump(tape, bhr, perturbation=drawn)


def test_a_shoved_robot_tips(fall):
    found = signs(fall)
    assert not fall.landed and fall.checks_passed
    times = {sign.cause: sign.time_s for sign in found}
    assert [sign.time_s for sign in found] == sorted(times.values())
    begun = fall.settings["pushes"][0]["step"] * STEP_S
    assert begun < times["tip"] < begun + 0.5
    assert str(found[0]) == f"{found[0].cause} from {found[0].time_s:.3f} s"


def test_each_cause_is_read_from_its_own_numbers(bhr, fall):
    """Logs made up: a quiet stand that is called a failure, with one thing wrong in each."""
    n, q = 400, stance_configuration(bhr)
    whole = np.tile(q, (n, 1))
    wrench = np.zeros((n, 2, 6))
    wrench[:, :, 2] = 206.0
    quiet = replace(
        fall, t=np.arange(n) * STEP_S, q=whole, v=np.zeros((n, 20)), tau=np.full((n, 14), 0.1), foot_wrench=wrench,
        com=np.tile(momentum(bhr, q, np.zeros(20))[0], (n, 1)), com_velocity=np.zeros((n, 3)),
        phase=np.where(np.arange(n) < 100, "flight", "landing"), touching=np.zeros((n, len(fall.link_names)), bool),
        robot=bhr)  # fmt: skip
    assert signs(quiet) == (Sign("other", 0.399),)
    slides, turned, stopped, spent, tips = (
        getattr(quiet, x).copy() for x in ("foot_wrench", "q", "q", "tau", "com_velocity")
    )
    slides[200:240, 1, 0] = 0.98 * 206  # of friction 1
    turned[100, 3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, 0.7, 0.0)).coeffs()
    knee = 7 + bhr.joint_names.index("right_knee")
    stopped[250:270, knee] = bhr.actuators["right_knee"]["upper"]
    spent[300:360, 3] = bhr.actuators[bhr.joint_names[3]]["effort"]
    tips[350:, 0] = 2.0
    for changed, sign in ((dict(foot_wrench=slides), Sign("slip", 0.2)), (dict(q=turned), Sign("over-rotation", 0.1)),
                          (dict(q=stopped), Sign("knee stop", 0.25)), (dict(tau=spent), Sign("torque", 0.3)),
                          (dict(com_velocity=tips), Sign("tip", 0.35))):  # fmt: skip
        (found,) = signs(replace(quiet, **changed))
        assert found.cause == sign.cause and found.time_s == pytest.approx(sign.time_s)
    both = signs(replace(quiet, tau=spent, com_velocity=tips, foot_wrench=slides))
    assert [sign.cause for sign in both] == ["slip", "torque", "tip"]
    tilted = quiet.settings | {"ground": asdict(slope(0.1))}  # towards which the force leans
    assert signs(replace(quiet, foot_wrench=slides, settings=tilted))[0].cause == "other"
    short = slides.copy()
    short[215:] = wrench[215:]
    assert signs(replace(quiet, foot_wrench=short))[0].cause == "other"
    landed = replace(quiet, metrics=replace(fall.metrics, landed=True))
    assert signs(landed) == ()
    with pytest.raises(ValueError, match="robot is not known"):
        signs(replace(quiet, robot=None))
