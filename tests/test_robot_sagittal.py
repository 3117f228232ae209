"""The default robot's reduction to five links, its stance, and joint axes that point the other way."""

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, full_state, inverse_dynamics
from fixtures_robots import refused
from paper import bhr_table as table
from paper.planar import evaluator

from jumplab.models.full import FullBody
from jumplab.robot import SAGITTAL_LINKS, Robot
from jumplab.robot.stance import com_from_toe, stance_angles, stance_configuration


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
    np.testing.assert_array_equal(s.signs[:, 0], 1.0)
    assert (s.lower[1], s.upper[1]) == (table.value("knee_lower"), table.value("knee_upper"))


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
    angles = stance_angles(bhr.with_stance(knee_rad=knee))
    assert com_from_toe(bhr, angles)[0] == pytest.approx(bhr.sagittal.sole_center[0], abs=1e-9)
    assert bhr.sagittal.joint_angles(angles)[1] == pytest.approx(knee)


@pytest.mark.parametrize("effort", [6.0, 2.0, 60.0])
def test_weak_ankles_hold_the_stance_with_a_share_of_their_torque(bhr, effort):
    """The CoM stands above the middle of the soles, or nearer to the ankles: these then use two fifths."""
    robot = bhr.with_limits(joints={"ankle_pitch": {"effort": effort}})
    q, zero, weight = stance_configuration(robot), np.zeros(20), 42.0 * 9.8
    com = pin.centerOfMass(robot.model, robot.model.createData(), q)[0]
    left = inverse_dynamics(robot, q, zero, zero, (0.0, weight, -weight * com), (0.0, 0.0))
    np.testing.assert_allclose(left[:6], 0, atol=1e-8)
    needs = [abs(left[robot.model.idx_vs[robot.model.getJointId(x)]]) for x in robot.joints["ankle_pitch"]]
    ahead = com + 0.02  # of the ankles: they are so far behind the middle of bhr's soles
    assert ahead == pytest.approx(min(0.02, 0.4 * effort / (weight / 2)), abs=1e-9)
    assert max(needs) <= 0.4 * effort  # a little less: the feet's own weight is not on them


# axes ---------------------------------------------------------------------------------------------------------------
def test_sides_that_share_no_angle_are_refused(bhr):
    head, tail = bhr.urdf.split('<joint name="right_knee"')
    turned = head + '<joint name="right_knee"' + tail.replace('lower="0" upper="2.4"', 'lower="-2.4" upper="-0.1"', 1)
    assert refused(lambda: Robot.from_text(turned, bhr.config_text).sagittal) == (
        "'left_knee' and 'right_knee' have no angle in common: 0 ... 2.4 and -2.4 ... -0.1 rad about the same axis; "
        "correct their limits"
    )
