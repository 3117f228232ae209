"""The default robot in three engines, its sagittal reduction, its reach, and files that describe no robot."""

import io
import itertools
import tokenize
from dataclasses import FrozenInstanceError
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
import pybullet
import pytest
from fixtures_core import LIMBS, full_state, inverse_dynamics
from scipy.stats import qmc

import jumplab
from jumplab.errors import RobotError
from jumplab.models.full import FullBody
from jumplab.models.planar import evaluator
from jumplab.robot import SAGITTAL_LINKS, Robot, load_robot
from jumplab.robot.bhr import table
from jumplab.robot.description import GRAVITY, SHIPPED
from jumplab.robot.reach import postures, reach, sobol
from jumplab.robot.stance import com_from_toe, configuration, stance_angles, stance_configuration
from jumplab.task import GRAVITY as TASK_GRAVITY

MASSIVE = {"trunk", *(f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot", "arm"))}


def with_free_base(urdf: str) -> str:
    """MuJoCo welds a URDF's root to the world and drops its mass; a floating joint keeps it."""
    root = (
        '<link name="world"/><joint name="root" type="floating"><parent link="world"/><child link="trunk"/></joint>'
        '<link name="trunk">'
    )
    return urdf.replace('<link name="trunk">', root, 1)


@pytest.fixture(scope="module")
def in_mujoco(bhr):
    return mujoco.MjModel.from_xml_string(with_free_base(bhr.urdf))


@pytest.fixture
def in_pybullet(bhr, tmp_path):
    (tmp_path / "robot.urdf").write_text(bhr.urdf)
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    yield pybullet.loadURDF(str(tmp_path / "robot.urdf"), flags=flags, physicsClientId=client), client
    pybullet.disconnect(client)


# the file -------------------------------------------------------------------------------------------------------
def test_urdf_is_built_from_the_table():
    assert table.URDF_PATH.read_text() == table.build_urdf()


def test_every_number_has_unit_and_source():
    for name, row in table.TABLE.items():
        assert np.isfinite(row.value) and row.unit and row.source, name
        assert row.source.startswith(("paper", "our choice", "geometry", "mechanical")), name


def test_counts_and_size(bhr):  # N-4, N-5
    model = bhr.model
    assert (model.nq, model.nv, len(bhr.joint_names)) == (21, 20, 14)
    assert bhr.total_mass == pytest.approx(42.0, abs=1e-9)
    assert sum(inertia.mass > 0.1 for inertia in model.inertias) == 9
    shapes = pin.buildGeomFromUrdfString(model, bhr.urdf, pin.GeometryType.COLLISION)
    data, places = model.createData(), shapes.createData()
    pin.updateGeometryPlacements(model, data, shapes, places, pin.neutral(model))
    middle = np.array([place.translation[2] for place in places.oMg])
    half = np.array([shape.geometry.halfSide[2] for shape in shapes.geometryObjects])
    assert max(middle + half) - min(middle - half) == pytest.approx(1.5, abs=1e-9)


def test_pybullet_sees_the_same_masses(bhr, in_pybullet):
    robot, client = in_pybullet
    masses = {}
    for i in range(-1, pybullet.getNumJoints(robot, physicsClientId=client)):
        name = "trunk" if i < 0 else pybullet.getJointInfo(robot, i, physicsClientId=client)[12].decode()
        masses[name] = pybullet.getDynamicsInfo(robot, i, physicsClientId=client)[0]
    assert sum(masses.values()) == pytest.approx(42.0, abs=1e-9)
    assert {name for name, mass in masses.items() if mass > 0.1} == MASSIVE
    movable = [i for i in range(len(masses) - 1) if pybullet.getJointInfo(robot, i, physicsClientId=client)[2] == 0]
    assert len(movable) == 14


def test_mujoco_sees_the_same_masses(in_mujoco):
    names = [in_mujoco.body(i).name for i in range(1, in_mujoco.nbody)]
    masses = dict(zip(names, in_mujoco.body_mass[1:], strict=True))
    assert sum(masses.values()) == pytest.approx(42.0, abs=1e-9)
    assert {name for name, mass in masses.items() if mass > 0.1} == MASSIVE
    assert (in_mujoco.nv, in_mujoco.njnt) == (20, 15)


def test_mass_matrix_in_mujoco(bhr, in_mujoco):
    """One number for each pair of velocities: nothing of geometry, mass or inertia can differ."""
    model, data, rng = bhr.model, bhr.model.createData(), np.random.default_rng(2)
    there, names = mujoco.MjData(in_mujoco), bhr.joint_names
    columns = [in_mujoco.jnt_dofadr[mujoco.mj_name2id(in_mujoco, mujoco.mjtObj.mjOBJ_JOINT, n)] for n in names]
    rows = [in_mujoco.jnt_qposadr[mujoco.mj_name2id(in_mujoco, mujoco.mjtObj.mjOBJ_JOINT, n)] for n in names]
    order = np.r_[0:6, columns]
    for _ in range(3):
        q = pin.neutral(model)  # the base upright: there, both engines mean the same six base velocities
        q[7:] = rng.uniform(-0.5, 0.5, 14)
        there.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        there.qpos[rows] = q[7:]
        mujoco.mj_forward(in_mujoco, there)
        full = np.zeros((20, 20))
        mujoco.mj_fullM(in_mujoco, there, full)
        ours = pin.crba(model, data, q)
        ours = np.triu(ours) + np.triu(ours, 1).T
        np.testing.assert_allclose(full[np.ix_(order, order)], ours, atol=1e-9)


def test_gravity_is_the_papers_everywhere(bhr):
    assert TASK_GRAVITY == GRAVITY == 9.8
    np.testing.assert_array_equal(bhr.model.gravity.linear, [0, 0, -9.8])
    for path in Path(jumplab.__file__).parent.rglob("*.py"):
        for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
            assert not (token.type == tokenize.NUMBER and token.string.startswith("9.81")), f"{path}:{token.start[0]}"


def test_robot_is_immutable_and_its_hash_is_its_text(bhr):
    with pytest.raises(FrozenInstanceError):
        bhr.name = "other"
    assert bhr.hash == load_robot().hash and len(bhr.hash) == 12
    assert Robot.from_text(bhr.urdf + " ", bhr.config_text).hash != bhr.hash
    assert Robot.from_text(bhr.urdf, bhr.config_text + "\n# a remark").hash != bhr.hash


def test_actuators_are_those_of_the_table(bhr):
    for name, actuator in bhr.actuators.items():
        kind = name.split("_", 1)[1]
        assert actuator["effort"] == table.value(f"{kind}_effort") and actuator["speed"] == table.value(f"{kind}_speed")
        assert actuator["corner_speed"] == pytest.approx(bhr.corner_speed_ratio * actuator["speed"])
        assert actuator["lower"] < actuator["upper"]


# geometry -------------------------------------------------------------------------------------------------------
class Shapes:
    """Boxes of the robot; which of different links touch at given joint angles (both sides alike)."""

    def __init__(self, robot):
        self.robot, self.model = robot, robot.model
        self.shapes = pin.buildGeomFromUrdfString(self.model, robot.urdf, pin.GeometryType.COLLISION)
        self.shapes.addAllCollisionPairs()
        self.data, self.result = self.model.createData(), self.shapes.createData()

    def touching(self, **angles) -> set[tuple[str, str]]:
        q = pin.neutral(self.model)
        for kind, angle in angles.items():
            for side, sign in (("left", 1), ("right", -1 if kind.endswith(("roll", "yaw")) else 1)):
                q[self.model.idx_qs[self.model.getJointId(f"{side}_{kind}")]] = sign * angle
        pin.computeCollisions(self.model, self.data, self.shapes, self.result, q, False)
        found = set()
        for pair, hit in zip(self.shapes.collisionPairs, self.result.collisionResults, strict=True):
            a, b = (self.shapes.geometryObjects[i] for i in (pair.first, pair.second))
            if hit.isCollision() and a.parentJoint != b.parentJoint:
                found.add(tuple(sorted((a.name, b.name))))
        return found

    def grid(self, kind, count):
        limits = self.robot.actuators[f"left_{kind}"]
        return np.linspace(limits["lower"], limits["upper"], count)


@pytest.fixture(scope="module")
def shapes(bhr):
    return Shapes(bhr)


def test_nothing_touches_within_the_ranges(shapes):
    """No two links but thigh and shank of one leg (joined by the knee) over the whole grid of symmetric postures."""
    found = {}
    for angles in itertools.product(*(shapes.grid(kind, n) for kind, n in zip(LIMBS, (9, 7, 5, 9), strict=True))):
        for pair in shapes.touching(**dict(zip(LIMBS, angles, strict=True))):
            found.setdefault(pair, angles)
    assert not {p for p in found if p not in {(f"{s}_shank_0", f"{s}_thigh_0") for s in ("left", "right")}}, found


def test_knee_range_is_real(shapes):
    """Thigh and shank do not run into each other before the knee's stop."""
    free = [knee for knee in shapes.grid("knee", 49) if not shapes.touching(knee=knee)]
    assert max(free) == shapes.grid("knee", 2)[1], f"thigh and shank touch beyond {max(free):.2f} rad"


@pytest.mark.parametrize("kind", ["hip_roll", "hip_yaw", "ankle_roll"])
def test_other_ranges_are_real(shapes, kind):
    for angle in shapes.grid(kind, 15):
        assert not shapes.touching(**{kind: angle}), angle


def test_trunk_and_thigh_would_meet_soon_beyond_the_hip_range(shapes):
    """The range is the geometry's: 0.15 rad further they touch."""
    lower = shapes.robot.actuators["left_hip_pitch"]["lower"]
    assert not shapes.touching(hip_pitch=lower)
    assert ("left_thigh_0", "trunk_0") in shapes.touching(hip_pitch=lower - 0.15)


def test_sole_is_the_bottom_of_the_foots_box(bhr, shapes):
    foot, size = bhr.foot, {s.name: s for s in shapes.shapes.geometryObjects}
    for name in foot.frames:
        frame = bhr.model.frames[bhr.model.getFrameId(name)]
        box = size[f"{name}_0"]
        place, half = frame.placement.actInv(box.placement).translation, box.geometry.halfSide
        want = np.array([foot.heel, -foot.half_width, foot.sole_z]), np.array([foot.toe, foot.half_width])
        np.testing.assert_allclose(place - half, want[0], atol=1e-12)
        np.testing.assert_allclose((place + half)[:2], want[1], atol=1e-12)
    assert foot.toe - foot.heel == pytest.approx(0.24) and 2 * foot.half_width == pytest.approx(0.10)


# sagittal reduction ---------------------------------------------------------------------------------------------
def random_motions(count, seed=4):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield rng.uniform(-1.2, 1.2, 5), rng.normal(scale=3, size=5), rng.normal(scale=20, size=5), rng


def test_five_links_are_the_whole_robot(bhr):  # N-6
    s = bhr.sagittal
    assert s.total_mass == pytest.approx(bhr.total_mass, abs=1e-12)
    assert SAGITTAL_LINKS == ("foot", "shank", "thigh", "trunk", "arm")
    np.testing.assert_allclose(s.mass, [2.002, 6.0, 10.0, 19.998, 4.0], atol=1e-12)  # with the dummies
    np.testing.assert_allclose(s.effort, [2 * table.value(f"{kind}_effort") for kind in LIMBS])
    np.testing.assert_allclose(s.speed, [table.value(f"{kind}_speed") for kind in LIMBS])
    np.testing.assert_array_equal(s.sign, 1.0)


def test_same_momentum_and_inertia_as_nine_links_and_pinocchio(bhr):
    model, data, planar, nine = bhr.model, bhr.model.createData(), evaluator(bhr.sagittal), FullBody(bhr)
    for angles, rates, accels, rng in random_motions(6):
        toe, speed = rng.normal(size=2), rng.normal(size=2)
        q, v, _ = full_state(bhr, angles, rates, accels, toe, speed)
        pin.ccrba(model, data, q, v)
        five = planar(angles=angles, rates=rates, accels=accels, toe=np.zeros(2))
        np.testing.assert_allclose(toe + five["com"].full().ravel(), data.com[0][[0, 2]], atol=1e-9)
        velocity = data.hg.linear[[0, 2]] / bhr.total_mass
        np.testing.assert_allclose(speed + five["com_velocity"].full().ravel(), velocity, atol=1e-9)
        assert float(five["L"]) == pytest.approx(data.hg.angular[1], abs=1e-9)
        assert float(five["rho"]) == pytest.approx(data.Ig.inertia[1, 1], abs=1e-9)
        np.testing.assert_allclose(data.hg.vector[[1, 3, 5]], 0, atol=1e-9)  # nothing leaves the plane
        full = nine.terms(q, v)
        np.testing.assert_allclose(full.com, data.com[0], atol=1e-9)
        np.testing.assert_allclose(full.momentum, data.hg.vector, atol=1e-9)
        assert full.rho == pytest.approx(float(five["rho"]), abs=1e-9) and nine.mass == pytest.approx(42.0, abs=1e-9)


def test_same_dynamics_as_pinocchio(bhr):
    """Joint torques and ground wrench of the five links satisfy all 20 rows of the full robot, toe still or not."""
    planar = evaluator(bhr.sagittal)
    still = np.zeros(2)
    for i, (angles, rates, accels, rng) in enumerate(random_motions(8, seed=6)):
        toe, jolt = rng.normal(size=2), still if i % 2 else 10 * rng.normal(size=2)
        five = {k: x.full().ravel() for k, x in planar(angles=angles, rates=rates, accels=accels, toe=jolt).items()}
        force = 42.0 * (five["com_acceleration"] + jolt + [0, 9.8])
        moment = five["L_rate"][0] + five["com"][1] * force[0] - five["com"][0] * force[1]
        wrench = np.array([*force, moment])
        if i % 2:
            np.testing.assert_allclose(five["ground_wrench"], wrench, atol=1e-9)
        q, v, a = full_state(bhr, angles, rates, accels, toe, toe_acceleration=jolt)
        left = inverse_dynamics(bhr, q, v, a, wrench, toe)
        for role, torque in zip(LIMBS, five["torques"], strict=True):
            for name in bhr.joints[role]:
                left[bhr.model.idx_vs[bhr.model.getJointId(name)]] -= torque / 2
        sideways = [bhr.model.idx_vs[bhr.model.getJointId(n)] for n in bhr.joint_names if n.endswith(("roll", "yaw"))]
        inside = np.setdiff1d(np.arange(20), [1, 3, 5, *sideways])
        np.testing.assert_allclose(left[inside], 0, atol=1e-8)
        np.testing.assert_allclose(left[[1, 3, 5]], 0, atol=1e-8)  # by symmetry


def test_joint_and_link_angles_are_inverse(bhr):
    rng, s = np.random.default_rng(0), bhr.sagittal
    angles = rng.normal(size=(7, 5))
    np.testing.assert_allclose(s.link_angles(s.joint_angles(angles), angles[:, 3]), angles, atol=1e-12)


def test_points_lie_where_pinocchio_sees_them(bhr):
    model, data, s = bhr.model, bhr.model.createData(), bhr.sagittal
    angles, rates, accels, _ = next(random_motions(1))
    q, _, _ = full_state(bhr, angles, rates, accels)
    pin.framesForwardKinematics(model, data, q)

    def planar(name):
        state = sum(turn @ arm for turn, arm in zip(turns, s.point_arms(*s.points[name]), strict=True))
        return np.asarray(state)

    turns = [np.array([[np.cos(x), np.sin(x)], [-np.sin(x), np.cos(x)]]) for x in angles]
    for name, joint in (("knee", "left_knee"), ("hip", "left_hip_pitch"), ("shoulder", "left_shoulder_pitch")):
        np.testing.assert_allclose(planar(name), data.oMi[model.getJointId(joint)].translation[[0, 2]], atol=1e-12)
    foot = data.oMf[model.getFrameId("left_foot")]
    np.testing.assert_allclose(planar("heel"), foot.act(bhr.foot.corners[0])[[0, 2]], atol=1e-12)


def test_hand_is_the_end_of_the_arm(bhr):
    """Clearance of the hand is worth what the hand's place is worth: the end of the arm's box."""
    length = table.value("arm_length")
    assert np.linalg.norm(bhr.sagittal.points["hand"][1]) == pytest.approx(length, abs=0.005)


# stance ---------------------------------------------------------------------------------------------------------
def test_stance_is_in_balance(bhr):
    angles, model = stance_angles(bhr), bhr.model
    q, data = stance_configuration(bhr), model.createData()
    pin.centerOfMass(model, data, q)
    pin.updateFramePlacements(model, data)
    assert abs(data.com[0][0]) < 1e-9  # above the middle of the soles, which is the origin
    for name in bhr.foot.frames:
        corners = np.array([data.oMf[model.getFrameId(name)].act(c) for c in bhr.foot.corners])
        np.testing.assert_allclose(corners[:, 2], 0, atol=1e-12)
        assert corners[:, 0].mean() == pytest.approx(0, abs=1e-12)
    joints = bhr.sagittal.joint_angles(angles)
    assert joints[1] == pytest.approx(bhr.stance["knee_rad"]) and angles[3] == bhr.stance["trunk_pitch_rad"]
    assert np.all(joints >= bhr.sagittal.lower) and np.all(joints <= bhr.sagittal.upper)


def test_stance_at_rest_is_statics(bhr):
    """Half of the weight at the middle of each sole carries the robot, with the torques of the planar model."""
    angles, zero = stance_angles(bhr), np.zeros(5)
    five = evaluator(bhr.sagittal)(angles=angles, rates=zero, accels=zero, toe=np.zeros(2))
    weight = 42.0 * 9.8
    left = inverse_dynamics(bhr, stance_configuration(bhr), np.zeros(20), np.zeros(20), (0.0, weight, 0.0), (0.0, 0.0))
    np.testing.assert_allclose(left[:6], 0, atol=1e-8)
    for role, torque in zip(LIMBS, five["torques"].full().ravel(), strict=True):
        for name in bhr.joints[role]:
            assert left[bhr.model.idx_vs[bhr.model.getJointId(name)]] == pytest.approx(torque / 2, abs=1e-8)
    fx, fz, moment = five["ground_wrench"].full().ravel()
    assert (fx, fz) == pytest.approx((0.0, weight), abs=1e-9)
    assert -moment / fz == pytest.approx(bhr.sagittal.sole_center[0], abs=1e-9)  # CoP below the CoM


@pytest.mark.parametrize("knee", [0.1, 0.5, 1.0, 1.6])
def test_stance_follows_the_knee(bhr, knee):
    angles = stance_angles(bhr, knee)
    assert com_from_toe(bhr, angles)[0] == pytest.approx(bhr.sagittal.sole_center[0], abs=1e-9)
    assert bhr.sagittal.joint_angles(angles)[1] == pytest.approx(knee)


# reach ----------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def envelope(bhr):
    return reach(bhr)


def test_sampled_postures_are_real(bhr):
    """CoM and inertia of sampled postures are Pinocchio's, and their joints lie within the ranges."""
    found, s = postures(bhr, 2**10), bhr.sagittal
    joints = s.joint_angles(found["angles"])
    assert np.all(joints >= s.lower - 1e-12) and np.all(joints <= s.upper + 1e-12) and len(joints) > 50
    model, data = bhr.model, bhr.model.createData()
    for i in range(0, len(joints), 50):
        q = configuration(bhr, found["angles"][i], toe=-s.sole_center)
        pin.ccrba(model, data, q, np.zeros(20))
        np.testing.assert_allclose(found["com"][i], data.com[0][[0, 2]], atol=1e-9)
        assert found["rho"][i] == pytest.approx(data.Ig.inertia[1, 1], abs=1e-9)


def test_envelope_is_an_envelope(bhr, envelope):
    found = postures(bhr, 2**12)
    phi = np.linalg.norm(found["com"], axis=1)
    inside = (phi > envelope.length_grid[0]) & (phi < envelope.length_grid[-1])
    low, high = (np.polyval(fit, phi[inside]) for fit in (envelope.inertia_low_fit, envelope.inertia_high_fit))
    rho = found["rho"][inside]
    assert np.all(low < high) and np.all(envelope.internal_inertia < low)
    assert np.mean((rho > low) & (rho < high)) > 0.9  # 2 % are cut off on either side, and a parabola is not exact
    assert np.all(np.polyval(envelope.force_fit, envelope.length_grid) > 42 * 9.8)  # it can stand at any length
    assert np.all(np.polyval(envelope.speed_fit, envelope.length_grid) > 0)
    assert envelope.mass == pytest.approx(42.0) and envelope.cop == pytest.approx((-0.12, 0.12))
    assert envelope.internal_inertia == pytest.approx(bhr.sagittal.inertia.sum())


def test_reach_starts_from_the_stance(bhr, envelope):
    q, model, data = stance_configuration(bhr), bhr.model, bhr.model.createData()
    pin.ccrba(model, data, q, np.zeros(20))
    lean, length, turn, radius = envelope.start
    np.testing.assert_allclose(length * np.array([np.sin(lean), np.cos(lean)]), data.com[0][[0, 2]], atol=1e-9)
    assert 42.0 * radius**2 == pytest.approx(data.Ig.inertia[1, 1], abs=1e-9)
    assert lean + turn == pytest.approx(bhr.stance["trunk_pitch_rad"], abs=1e-9)  # theta_l + theta_pl is the trunk


def test_reach_is_deterministic(bhr, envelope):
    again = reach(bhr)
    np.testing.assert_array_equal(again.inertia_high, envelope.inertia_high)
    np.testing.assert_array_equal(again.force_fit, envelope.force_fit)


def test_heavier_limbs_widen_the_envelope(bhr, envelope):
    """The envelope is the robot's own: arms of four times the mass reach out to more inertia."""
    head, tail = bhr.urdf.split('<link name="left_arm">')
    heavy = head + '<link name="left_arm">' + tail.replace('<mass value="2" />', '<mass value="8" />')
    other = reach(Robot.from_text(heavy, bhr.config_text), 2**12)
    assert other.inertia[1] > envelope.inertia[1] + 1.0


# descriptions that are no robot ---------------------------------------------------------------------------------
def test_unknown_robot(tmp_path):
    with pytest.raises(RobotError) as e:
        load_robot("atlas")
    known = ", ".join(SHIPPED)
    assert str(e.value) == f"robot 'atlas': neither a shipped robot ({known}) nor a readable TOML file"
    assert e.value.exit_code == 2
    for name in (str(tmp_path), "", "a\0b", "x" * 5000):
        with pytest.raises(RobotError, match=r"neither a shipped robot \(bhr, .*\) nor a readable TOML file$"):
            load_robot(name)


def changed(robot, old, new=""):
    assert old in robot.config_text
    return Robot.from_text(robot.urdf, robot.config_text.replace(old, new, 1))


@pytest.mark.parametrize("line, entry", [
    ('name = "bhr"', "name"),
    ('knee = ["left_knee", "right_knee"]', "joints.knee"),
    ("sole_x_m = [-0.10, 0.14]", "feet.sole_x_m"),
    ("knee_rad = 0.5", "stance.knee_rad"),
    ("corner_speed_ratio = 0.5", "actuators.corner_speed_ratio"),
])  # fmt: skip
def test_missing_entries(bhr, line, entry):
    with pytest.raises(RobotError) as e:
        changed(bhr, line)
    assert str(e.value) == f"robot configuration: the entry {entry!r} is missing"


WRONG = [
    ('"left_knee"', '"left_elbow"', "robot bhr: role knee names the joint 'left_elbow', which the URDF lacks"),
    ('"left_foot"', '"left_shoe"', "robot bhr: the foot link 'left_shoe' is not in the URDF"),
    ("corner_speed_ratio = 0.5", "corner_speed_ratio = 1.0",
     "robot configuration: corner_speed_ratio = 1 must lie between 0 and 1"),
    ("[-0.10, 0.14]", "[0.14, -0.10]",
     "robot configuration: the sole [0.14, -0.1] x [-0.05, 0.05] m has no area; give [heel, toe] and [right, left]"),
    ("knee_rad = 0.5", "knee_rad = nan", "robot configuration: 'stance.knee_rad' = nan, must be a finite number"),
]  # fmt: skip


@pytest.mark.parametrize("old, new, sentence", WRONG)
def test_wrong_entries(bhr, old, new, sentence):
    with pytest.raises(RobotError) as e:
        changed(bhr, old, new)
    assert str(e.value) == sentence


def test_files_that_cannot_be_read(bhr, tmp_path):
    config = tmp_path / "robot.toml"
    config.write_text("name = ")
    with pytest.raises(RobotError, match=r"robot\.toml: not a TOML file: "):
        load_robot(str(config))
    config.write_text(bhr.config_text)
    with pytest.raises(RobotError) as e:
        load_robot(str(config))
    assert str(e.value) == f"{tmp_path / 'bhr.urdf'}: there is no such file; give the path of a URDF"
    (tmp_path / "bhr.urdf").write_text("<robot")
    with pytest.raises(RobotError, match=r"^robot bhr: the URDF is no well-formed XML: "):
        load_robot(str(config))
    (tmp_path / "bhr.urdf").write_text(bhr.urdf)
    assert load_robot(str(config)).hash == bhr.hash


def test_a_posture_that_cannot_stand(bhr):
    with pytest.raises(RobotError) as e:
        stance_angles(changed(bhr, "[-0.10, 0.14]", "[2.0, 2.2]"))
    assert str(e.value) == (
        "robot bhr: with the knee at 0.5 rad and the trunk at 0.05 rad no lean of the shank brings the CoM above the "
        "middle of the sole; change [stance] in its configuration"
    )


def test_a_stance_beyond_the_joint_range_is_refused(bhr):
    with pytest.raises(RobotError, match="knee"):
        stance_angles(changed(bhr, "knee_rad = 0.5", "knee_rad = 3.0"))


def test_a_role_must_turn_about_the_pitch_axis(bhr):
    with pytest.raises(RobotError, match="left_hip_roll"):
        _ = changed(bhr, '["left_knee", "right_knee"]', '["left_hip_roll", "right_hip_roll"]').sagittal


def flipped(robot, *joints):
    """The same robot, with some joint axes (and ranges) written the other way round."""
    urdf = robot.urdf
    for joint in joints:
        head, tail = urdf.split(f'<joint name="{joint}"', 1)
        body, rest = tail.split("</joint>", 1)
        a = robot.actuators[joint]
        body = body.replace('xyz="0 1 0"', 'xyz="0 -1 0"')
        body = body.replace(f'lower="{a["lower"]:.10g}" upper="{a["upper"]:.10g}"',
                            f'lower="{-a["upper"]:.10g}" upper="{-a["lower"]:.10g}"')  # fmt: skip
        urdf = f'{head}<joint name="{joint}"{body}</joint>{rest}'
    return Robot.from_text(urdf, robot.config_text)


def test_axes_may_point_the_other_way(bhr):
    """Signs are found by motion: the same robot with its knees' axes turned round is the same robot."""
    other = flipped(bhr, "left_knee", "right_knee")
    assert other.sagittal.sign[1] == -1
    np.testing.assert_allclose(other.sagittal.lower, bhr.sagittal.lower)
    np.testing.assert_allclose(other.sagittal.upper, bhr.sagittal.upper)
    angles = stance_angles(bhr, 1.2)
    places = []
    for robot in (bhr, other):
        data = robot.model.createData()
        places.append(pin.centerOfMass(robot.model, data, configuration(robot, angles)).copy())
    np.testing.assert_allclose(*places, atol=1e-12)


def test_axes_may_be_mirrored(bhr):
    """One knee turned round: both knees still bend the same way."""
    other = flipped(bhr, "right_knee")
    np.testing.assert_array_equal(other.sagittal.signs[1], [1, -1])
    angles = stance_angles(other, 1.2)
    q = configuration(other, angles)
    left, right = (q[other.model.idx_qs[other.model.getJointId(n)]] for n in other.joints["knee"])
    assert left == pytest.approx(-right) and left == pytest.approx(1.2)


def test_sides_that_share_no_angle_are_refused(bhr):
    robot = Robot.from_text(flipped(bhr, "right_knee").urdf.replace('xyz="0 -1 0"', 'xyz="0 1 0"'), bhr.config_text)
    with pytest.raises(RobotError) as e:
        _ = robot.sagittal
    assert str(e.value) == (
        "'left_knee' and 'right_knee' have no angle in common: 0 ... 2.4 and -2.4 ... -0 rad about the same axis; "
        "correct their limits"
    )


def test_limits_come_signed_and_doubled(bhr):
    s = bhr.sagittal
    assert np.all(s.lower < s.upper)
    assert s.lower[1] == table.value("knee_lower") and s.upper[1] == table.value("knee_upper")
    assert isinstance(evaluator(s), ca.Function)


def test_sobols_sequence_is_scipys():
    np.testing.assert_array_equal(sobol(2**10), qmc.Sobol(5, scramble=False).random(2**10))
