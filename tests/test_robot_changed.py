"""Robots with other limits and masses are other robots, checked, planned for and on file."""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from fixtures_robots import (
    alike,
    arm_base,
    held_arms,
    mirrored,
    needs_published,
    refused,
    roll_first,
    through_processes,
    write,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import jumplab as jl
from jumplab.errors import RobotError, nearest
from jumplab.robot import Robot
from jumplab.robot.files import ROLES

BHR = Robot.load()
PAGE = Path(__file__).parent.parent / "notebooks" / "book" / "robots.md"
SHORT = dict(zip(("hip", "knee", "ankle", "shoulder"), ROLES, strict=True))
LINKS = ("trunk", "left_thigh", "right_thigh", "left_foot", "right_arm")
KEYS = st.sampled_from([*BHR.joint_names, *ROLES, *SHORT])
FACTORS = st.floats(0.05, 20.0)


# limits ---------------------------------------------------------------------------------------------------------
@settings(deadline=None, derandomize=True, max_examples=10)
@given(effort=FACTORS | st.dictionaries(KEYS, FACTORS, max_size=4), speed=FACTORS | st.dictionaries(KEYS, FACTORS))
def test_factors_reach_the_joints_that_are_named_and_no_other(effort, speed):
    robot = BHR.with_limits(effort=effort, speed=speed)
    role_of = {name: role for role, pair in BHR.joints.items() for name in pair}
    for name, old in BHR.actuators.items():
        new, share = robot.actuators[name], {}
        for what, told in (("effort", effort), ("speed", speed)):
            if isinstance(told, dict):
                mine = [v for k, v in told.items() if SHORT.get(k, k) == role_of.get(name)]
                allowed = [told[name]] if name in told else mine or [1.0]
                share[what] = next(f for f in allowed if new[what] == pytest.approx(old[what] * f, rel=1e-10))
            else:
                share[what] = told
        assert new["effort"] == pytest.approx(old["effort"] * share["effort"], rel=1e-10)
        assert new["speed"] == pytest.approx(old["speed"] * share["speed"], rel=1e-10)
        assert new["corner_speed"] == robot.corner_speed_ratio * new["speed"]
        assert (new["lower"], new["upper"]) == (old["lower"], old["upper"])
        assert (f"of joint '{name}'" in robot.config_text) == (new != old)
    assert (robot.hash == BHR.hash) == (robot.actuators == BHR.actuators)
    assert alike(Robot.from_text(robot.urdf, robot.config_text), robot)
    assert robot.total_mass == BHR.total_mass and robot.joints == BHR.joints and robot.foot == BHR.foot


def test_a_joints_own_factor_counts_before_its_roles(bhr):
    robot = bhr.with_limits(speed={"left_knee": 0.5, "knee": 0.8})
    assert [robot.actuators[n]["speed"] for n in bhr.joints["knee"]] == [10.0, 16.0]
    assert robot.sagittal.speed[1] == 10.0 and robot.sagittal.corner_speed[1] == 5.0  # the weaker side's
    assert robot.config_text.removeprefix(bhr.config_text).splitlines() == [
        "# changed: speed of joint 'left_knee', 20 -> 10 rad/s",
        "# changed: speed of joint 'right_knee', 20 -> 16 rad/s",
    ]


def test_changes_add_up_and_no_change_is_no_other_robot(bhr):
    assert bhr.with_limits() is bhr and bhr.with_limits(effort=1, joints={"knee": {"lower": 0.0}}) is bhr
    assert bhr.with_mass("trunk", factor=1.0) is bhr
    twice = bhr.with_limits(effort=0.5).with_mass("trunk", factor=1.1).with_stance(knee_rad=0.6).with_limits(effort=1.6)
    assert twice.actuators == bhr.with_limits(effort=0.8).actuators and twice.stance["knee_rad"] == 0.6
    assert twice.total_mass == pytest.approx(bhr.total_mass + 0.1 * 19.994)
    assert len({bhr.hash, twice.hash, bhr.with_limits(effort=0.8).hash, bhr.with_limits(speed=0.8).hash}) == 4


def test_ranges_of_roles_are_in_sagittal_signs(bhr, tmp_path):
    turned = Robot.load(write(tmp_path, mirrored))
    assert set(turned.sagittal.signs[1]) == {1.0, -1.0}
    for robot in (bhr, turned):
        other = robot.with_limits(joints={"knee": {"upper": 2.0}, "ankle_pitch": {"lower": -0.7, "upper": 0.8}})
        np.testing.assert_allclose(other.sagittal.upper[[1, 2]], [2.0, 0.8])
        np.testing.assert_allclose(other.sagittal.lower[[1, 2]], [robot.sagittal.lower[1], -0.7])
        np.testing.assert_array_equal(other.sagittal.upper[[0, 3]], robot.sagittal.upper[[0, 3]])
    assert other.actuators["right_knee"]["lower"] == -2.0 and other.actuators["left_knee"]["upper"] == 2.0
    own = turned.with_limits(joints={"right_knee": {"lower": -1.9}})  # a joint's are its own
    assert own.actuators["right_knee"]["lower"] == -1.9 and own.sagittal.upper[1] == pytest.approx(1.9)


def body_of(model: pin.Model, link: str) -> pin.Inertia:
    return model.inertias[model.frames[model.getFrameId(link)].parentJoint]


# masses ---------------------------------------------------------------------------------------------------------
@settings(deadline=None, derandomize=True, max_examples=10)
@given(links=st.lists(st.sampled_from(LINKS), min_size=1, max_size=4), factor=st.floats(0.5, 2.0))
def test_inertia_scales_with_mass_and_nothing_else_moves(links, factor):
    robot = BHR.with_mass(links, factor=factor)
    there, here = ({name: body_of(r.model, name) for name in LINKS} for r in (robot, BHR))
    for name in LINKS:
        share = factor if name in links else 1.0
        assert there[name].mass == pytest.approx(share * here[name].mass, rel=1e-10)
        np.testing.assert_allclose(there[name].inertia, share * here[name].inertia, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(there[name].lever, here[name].lever, atol=1e-12)
    more = (factor - 1) * sum(here[name].mass for name in set(links))
    assert robot.total_mass == pytest.approx(BHR.total_mass + more, rel=1e-10)
    assert robot.sagittal.total_mass == pytest.approx(robot.total_mass, rel=1e-10)
    assert robot.actuators == BHR.actuators and alike(Robot.from_text(robot.urdf, robot.config_text), robot)


def test_a_mass_in_kilograms(bhr):
    robot = bhr.with_mass("trunk", mass_kg=22)
    assert robot.total_mass == pytest.approx(42.0 - 19.994 + 22)
    assert robot.config_text.removeprefix(bhr.config_text) == "# changed: mass of link 'trunk', 19.994 -> 22 kg\n"
    assert alike(robot, bhr.with_mass(["trunk"], mass_kg=22.0))
    assert bhr.with_mass(factor=1.1).total_mass == pytest.approx(1.1 * bhr.total_mass, rel=1e-9)  # all of it


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.25])
def test_longer_legs_weigh_the_same_and_spread_along_them(bhr, factor):
    robot = bhr.with_legs(factor)
    assert robot.total_mass == bhr.total_mass and robot.planar and (robot is bhr) == (factor == 1.0)
    there, here = ({name: body_of(r.model, name) for name in LINKS} for r in (robot, bhr))
    long = {f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank")}
    for name in LINKS:
        turn = np.diag([1.0, 1.0, factor if name in long else 1.0])  # of every particle, about the link's origin
        one, two = (x[name].toPseudoInertia().toMatrix() for x in (here, there))
        np.testing.assert_allclose(two[:3, :3], turn @ one[:3, :3] @ turn, atol=1e-9)
        np.testing.assert_allclose(two[:3, 3], turn @ one[:3, 3], atol=1e-9)
    for r, share in ((bhr, 1.0), (robot, factor)):
        model, data = r.model, r.model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model))
        hip, knee, ankle = (data.oMi[model.getJointId(r.joints[role][0])].translation for role in list(r.joints)[:3])
        np.testing.assert_allclose([hip[2] - knee[2], knee[2] - ankle[2]], 0.35 * share, atol=1e-12)


# every robot ----------------------------------------------------------------------------------------------------
def check_changes(robot: Robot) -> None:
    foot = list(robot.foot.frames)
    other = robot.with_limits(effort=0.8, speed={"hip": 0.9}, joints={"knee": {"upper": 1.8}}).with_mass(foot, factor=2)
    s, before = other.sagittal, robot.sagittal
    np.testing.assert_allclose(s.effort[:3], 0.8 * before.effort[:3])
    np.testing.assert_allclose(s.speed[:3], before.speed[:3] * [0.9, 1, 1])
    np.testing.assert_allclose(s.corner_speed[:3], before.corner_speed[:3] * [0.9, 1, 1])
    assert s.upper[1] == pytest.approx(1.8) and other.hash != robot.hash
    model = robot.model
    feet = sum(body_of(model, name).mass for name in foot)
    assert feet > 0.1 and other.total_mass - robot.total_mass == pytest.approx(feet, rel=1e-6)
    assert alike(Robot.from_text(other.urdf, other.config_text), other) and alike(through_processes(other), other)


@pytest.mark.parametrize("variant", [mirrored, roll_first, arm_base], ids=lambda v: v.__name__)
def test_imported_robots_take_the_same_changes(variant, tmp_path):
    check_changes(Robot.load(write(tmp_path, variant)))


@needs_published
def test_a_published_robot_takes_the_same_changes():
    robot = Robot.load("talos")
    check_changes(robot)
    trunk = robot.model.frames[2].name  # the base link: on file as two, one of them without a name of its own
    assert f'"{trunk}_rest"' in robot.urdf
    heavy = robot.with_mass(trunk, factor=1.25)
    assert heavy.total_mass - robot.total_mass == pytest.approx(0.25 * robot.model.inertias[1].mass)
    np.testing.assert_allclose(heavy.model.inertias[1].inertia, 1.25 * robot.model.inertias[1].inertia, rtol=1e-9)
    with pytest.raises(RobotError, match=f"cannot change the mass of '{trunk}_rest': there is no such link"):
        robot.with_mass(f"{trunk}_rest", factor=2)


def test_thighs_and_shanks_have_factors_of_their_own(bhr):
    robot = bhr.with_legs(thigh=1.1, shank=0.9)
    assert alike(robot, bhr.with_legs(thigh=1.1).with_legs(shank=0.9))
    lengths = [
        np.linalg.norm(robot.model.jointPlacements[robot.model.getJointId(f"left_{name}")].translation)
        for name in ("knee", "ankle_pitch")
    ]
    np.testing.assert_allclose(lengths, [1.1 * 0.35, 0.9 * 0.35])
    assert alike(bhr.with_legs(1.2), bhr.with_legs(thigh=1.2, shank=1.2))


def test_gears_trade_torque_against_speed(bhr):
    """Power stays, and what the motor itself takes grows: its inertia and damping with the square."""
    taken = "[actuators]\narmature = {left_knee = 0.02}\ndamping = {left_knee = 0.3}"
    config = bhr.config_text.replace("[actuators]", taken)
    own = Robot.from_text(bhr.urdf, config)
    robot = own.with_gears({"knee": 2.0, "right_knee": 0.5})
    left, right = (robot.actuators[name] for name in ("left_knee", "right_knee"))
    old = own.actuators["left_knee"]
    assert (left["effort"], left["speed"]) == (2 * old["effort"], old["speed"] / 2)
    assert left["effort"] * left["corner_speed"] == pytest.approx(old["effort"] * old["corner_speed"])
    assert (right["effort"], right["speed"]) == (old["effort"] / 2, 2 * old["speed"])
    assert (left["armature"], left["damping"], left["friction"]) == (0.08, 1.2, 0.0) and right["armature"] == 0.0
    assert robot.model.armature[robot.model.idx_vs[robot.model.getJointId("left_knee")]] == 0.08
    assert robot.hash != own.hash and bhr.with_gears({"knee": 1.0}).actuators == bhr.actuators
    assert alike(Robot.from_text(robot.urdf, robot.config_text), robot)


# refused --------------------------------------------------------------------------------------------------------
NOWHERE = "the robot cannot stand with knees at 0.3 ... 1.2 and the trunk at 0 ... 0.3 rad in [stance] either; "
NOWHERE += "correct its ranges or its soles"
REFUSED = [
    ("with_gears", {"ratios": {"knee": 0}}, "the factor on the gear of 'knee' must be a positive number, got 0"),
    ("with_gears", {"ratios": 2}, "the gears must be a mapping from joints or roles, got 2"),
    ("with_legs", {"thigh": "a"}, "the factor on the thighs must be a positive number, got 'a'"),
    ("with_legs", {"factor": -1}, "the factor on the legs must be a positive number, got -1"),
    ("with_limits", {"effort": 0}, "the factor on effort must be a positive number, got 0"),
    ("with_limits", {"effort": np.nan}, "the factor on effort must be a positive number, got nan"),
    ("with_limits", {"speed": "1"}, "the factor on speed must be a positive number, got '1'"),
    ("with_limits", {"speed": {"knee": True}}, "the factor on speed of 'knee' must be a positive number, got True"),
    ("with_limits", {"effort": {"kneee": 2.0}}, "the factors on effort name 'kneee', which is neither a role (hip, "
     f"knee, ankle, shoulder) nor a joint ({nearest(BHR.joint_names, 'kneee')})"),
    ("with_limits", {"joints": [("knee", 2.0)]},
     "the ranges must be a mapping from joints or roles, got [('knee', 2.0)]"),
    ("with_limits", {"joints": {"knee": {"low": 0.1}}},
     "the limits of 'knee' must be a mapping of lower, upper [rad], effort [N m] or speed [rad/s], got {'low': 0.1}"),
    ("with_limits", {"joints": {"knee": {"upper": np.inf}}}, "upper of 'knee' [rad] must be a finite number, got inf"),
    ("with_limits", {"joints": {"knee": {"lower": 3.0}}}, "joint 'left_knee' has range 3 ... 2.4 rad, effort 210 N m, "
     "speed 20 rad/s; all must be finite, positive and in order"),
    ("with_limits", {"joints": {"left_knee": {"upper": 0.6}, "right_knee": {"lower": 0.7}}},
     "with the knees at 0.5 rad and the trunk at 0.05 rad no posture stands on flat feet below the CoM: the nearest is "
     f"21 mm or mrad off, at most 1; {NOWHERE}"),
    ("with_limits", {"joints": {"knee": {"upper": 0.4}}},
     "standing with the knee at 0.5 rad needs knee at 0.500 rad, outside its range 0 ... 0.4; "
     "with knee_rad = 0.3 and trunk_pitch_rad = 0 in [stance] the robot can stand"),
    ("with_mass", {"link": "trunk"}, "give either mass_kg or factor to change a mass, and not both"),
    ("with_mass", {"link": "trunk", "mass_kg": -1}, "mass_kg of 'trunk' must be a positive number, got -1"),
    ("with_mass", {"link": "trunk", "factor": np.inf},
     "the factor on the mass of 'trunk' must be a positive number, got inf"),
]  # fmt: skip


@pytest.mark.parametrize("method, values, sentence", REFUSED, ids=range(len(REFUSED)))
def test_what_is_no_limit_and_no_mass_is_refused(bhr, method, values, sentence):
    assert refused(lambda: getattr(bhr, method)(**values)) == f"robot bhr: {sentence}"


@pytest.mark.parametrize("link", ["thigh", 3, [], ["trunk", {}], ("trunk", "left_knee")], ids=str)
def test_a_link_that_is_not_there(bhr, link):
    wrong = link[1] if isinstance(link, list | tuple) and link else link
    sentence = f"robot bhr: cannot change the mass of {wrong!r}: there is no such link; it has "
    assert refused(bhr.with_mass, link, factor=2.0).startswith(sentence)


def test_arms_that_are_held_have_no_limits(tmp_path):
    robot = Robot.load(write(tmp_path, held_arms))
    assert refused(lambda: robot.with_limits(effort={"shoulder": 2.0})) == (
        "robot held_arms: the factors on effort name 'shoulder', but no joint has this role: the arms are held; "
        "leave it out"
    )


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | KEYS | st.complex_numbers(),
    lambda x: st.lists(x, max_size=2) | st.dictionaries(KEYS | st.sampled_from(["lower", "upper"]), x, max_size=3),
)


@settings(deadline=None, derandomize=True, max_examples=8)
@given(effort=ANYTHING, joints=ANYTHING, link=ANYTHING, mass=ANYTHING)
def test_any_input_gives_a_sound_robot_or_one_sentence(effort, joints, link, mass):
    for change in (
        lambda: BHR.with_limits(effort=effort),
        lambda: BHR.with_limits(speed=effort, joints=joints),
        lambda: BHR.with_mass(link, mass_kg=mass),
        lambda: BHR.with_mass("trunk", factor=mass),
    ):
        try:
            robot = change()
        except RobotError as e:
            assert "\n" not in str(e)
        else:
            assert alike(Robot.from_text(robot.urdf, robot.config_text), robot)


# what comes of it -----------------------------------------------------------------------------------------------
def test_a_changed_robot_is_planned_audited_and_on_file(bhr, tmp_path):
    weak = bhr.with_limits(effort=0.8, speed={"knee": 0.9}).with_mass("trunk", mass_kg=21.0)
    plan = jl.plan(jl.JumpTask(distance_m=0.6, height_m=0.3), weak)
    assert jl.audit(plan).passed
    jl.save(tmp_path / "out", plan)
    assert alike(jl.load(tmp_path / "out").plan.robot, weak)
    assert "# changed: mass of link 'trunk', 19.994 -> 21 kg\n" in (tmp_path / "out" / "robot.toml").read_text()


@pytest.mark.slow
def test_a_robot_that_is_heavier_on_one_side_jumps_in_space(bhr):
    robot = bhr.with_mass("left_foot", factor=1.3)
    plan = jl.plan(jl.JumpTask(distance_m=0.3, height_m=0.2), robot)
    assert {row.stage.split(",")[0] for row in plan.statistics} == {"direct"}
    assert jl.audit(plan).passed


@needs_published
def test_the_lines_of_the_book():
    (block,) = re.findall(r"```python\n([^`]*with_limits[^`]*)```", PAGE.read_text(encoding="utf-8"))
    exec(f"import jumplab as jl\n{block}", said := {})
    robot, g1 = said["robot"], Robot.load("g1_legs")
    assert robot.stance["knee_rad"] == 0.6 and robot.model.inertias[1].mass == pytest.approx(12.0)
    np.testing.assert_allclose(robot.sagittal.effort[:3], 0.8 * g1.sagittal.effort[:3])
