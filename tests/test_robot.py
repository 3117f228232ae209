"""The default robot in three engines: masses, geometry, ranges."""

import ast
import itertools
from dataclasses import FrozenInstanceError
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import LIMBS, refused
from paper import bhr_table as table

import jumplab
from jumplab.errors import RobotError
from jumplab.robot import Robot
from jumplab.robot.description import GRAVITY
from jumplab.robot.stance import check_stance, stance_angles
from jumplab.task import GRAVITY as TASK_GRAVITY


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
    assert sum(inertia.mass > 0.1 for inertia in model.inertias) == 9  # trunk, thighs, shanks, feet, arms
    shapes = pin.buildGeomFromUrdfString(model, bhr.urdf, pin.GeometryType.COLLISION)
    data, places = model.createData(), shapes.createData()
    pin.updateGeometryPlacements(model, data, shapes, places, pin.neutral(model))
    middle = np.array([place.translation[2] for place in places.oMg])
    half = np.array([shape.geometry.halfSide[2] for shape in shapes.geometryObjects])
    assert max(middle + half) - min(middle - half) == pytest.approx(1.5, abs=1e-9)


def test_mass_matrix_in_mujoco(bhr, in_mujoco):
    """One number for each pair of velocities: nothing of geometry, mass or inertia can differ."""
    model, data, rng = bhr.model, bhr.model.createData(), np.random.default_rng(2)
    there = mujoco.MjData(in_mujoco)
    joints = [in_mujoco.joint(name) for name in bhr.joint_names]
    rows, order = [j.qposadr[0] for j in joints], [*range(6), *(j.dofadr[0] for j in joints)]
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
        for node in ast.walk(ast.parse(text)) if "9.81" in (text := path.read_text()) else ():
            assert not isinstance(node, ast.Constant) or node.value != 9.81, f"{path}:{node.lineno}"


def test_robot_is_immutable_and_its_hash_is_its_text(bhr):
    with pytest.raises(FrozenInstanceError):
        bhr.name = "other"
    assert bhr.hash == Robot.load().hash and len(bhr.hash) == 12
    assert Robot.from_text(bhr.urdf + " ", bhr.config_text).hash != bhr.hash
    assert Robot.from_text(bhr.urdf, bhr.config_text + "\n# a remark").hash != bhr.hash


def test_the_same_robot_in_another_stance(bhr):
    other = bhr.with_stance(knee_rad=1.0, trunk_pitch_rad=np.float64(0.2))
    assert other.stance == {"knee_rad": 1.0, "trunk_pitch_rad": 0.2, "shoulder_rad": 0.0}
    assert other.urdf == bhr.urdf and other.hash != bhr.hash and bhr.with_stance(**bhr.stance).hash == bhr.hash
    assert Robot.from_text(other.urdf, other.config_text).stance == other.stance  # as a result folder reads it
    assert other.joints == bhr.joints and other.foot == bhr.foot
    assert bhr.sagittal.joint_angles(stance_angles(other))[1] == pytest.approx(1.0)
    check_stance(other)


def test_a_stance_of_other_names_or_numbers(bhr):
    with pytest.raises(RobotError, match=r"^a stance has knee_rad, trunk_pitch_rad, shoulder_rad, not knee$"):
        bhr.with_stance(knee=1.0)
    assert refused(bhr.with_stance, knee_rad=np.nan) == "knee_rad must be finite, got nan"


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


@pytest.mark.parametrize("kind, count", [("knee", 49), ("hip_roll", 15), ("hip_yaw", 15), ("ankle_roll", 15)])
def test_ranges_of_single_joints_are_real(shapes, kind, count):
    """Nothing touches up to the stops."""
    assert not {angle: shapes.touching(**{kind: angle}) for angle in shapes.grid(kind, count)
                if shapes.touching(**{kind: angle})}  # fmt: skip


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
