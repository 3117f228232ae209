"""Words of the audit, and the places where its limits begin: on tapes of random numbers, a few ms each."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pinocchio as pin
import pytest
from fixtures_audit import ROBOT, robot_with
from fixtures_core import refused
from test_audit_amounts import JOINTS, random_tape, truth

from jumplab.auditing import AuditReport, Check, audit, write_audit
from jumplab.auditing.dynamics import available_torque
from jumplab.auditing.motion import form, mirror
from jumplab.auditing.replay import open_tape, replay
from jumplab.auditing.report import LIMITS, Limit
from jumplab.errors import InputError, RobotError
from jumplab.io import folder as store
from jumplab.io.folder import versions
from jumplab.robot.stance import stance_configuration
from jumplab.task import JumpTask

TASK = JumpTask(0.2, 0.05)
LEFT_FOOT = ROBOT.urdf[ROBOT.urdf.index('<link name="left_foot">') : ROBOT.urdf.index('<joint name="left_ankle_roll"')]


def with_foot(old: str, new: str):
    """The default robot with another left foot."""
    assert old in LEFT_FOOT
    return robot_with(urdf=(LEFT_FOOT, LEFT_FOOT.replace(old, new)))


# ------------------------------------------------------------------------------------------------------ the report


def test_a_limit_is_kept_by_its_own_value():
    most, least = Limit("a", "x", 2.0, "m", "what"), Limit("a", "x", 2.0, "m", "what", at_least=True)
    assert [most.check(x).passed for x in (2.0, 2.0 + 1e-12, math.nan, -9.0)] == [True, False, False, True]
    assert [least.check(x).passed for x in (2.0, 2.0 - 1e-12, math.nan, 9.0)] == [True, False, False, True]


def test_the_worst_is_the_first_of_equals_and_never_minus_zero():
    limit = Limit("a", "x", 2.0, "m", "at {here}, over {cop_force_n:g} N")
    found = limit.check([[1.0, 3.0], [3.0, 0.0]], [0.5, 0.6], ["p", "q"], {"here": "home"})
    assert found == Check("a", "x", 3.0, 2.0, "m", 0.5, "at home, over 50 N; worst: q", False)
    gap = limit.check([[1.0, np.nan], [5.0, 2.0]], [0.1, 0.2], ["p", "q"], {"here": ""})
    assert math.isnan(gap.value) and not gap.passed and gap.time == 0.1 and gap.note.endswith("worst: q")
    least = Limit("a", "low", 0.0, "m", "what", at_least=True).check([3.0, -1.0], [0.1, 0.2])
    assert (least.value, least.time, least.passed) == (-1.0, 0.2, False)
    assert math.copysign(1.0, limit.check([-0.0], [0.0], None, {"here": ""}).value) == 1.0
    assert limit.check(np.empty((0, 2)), [], ["p", "q"], {"here": "y"}) == Check(
        "a", "x", 2.0, 2.0, "m", None, "at y, over 50 N (nothing to check)", False
    )


def test_what_is_found_stays():
    r = replay(random_tape(0), ROBOT, None)
    for thing in (LIMITS["mass"], Check("g", "n", 1, 2, "m", None, ""), AuditReport(()), r):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(thing, dataclasses.fields(thing)[0].name, None)


def test_table_and_json_word_for_word():
    checks = (
        Check("one", "a", 0.123456, 1.0, "m", 0.25, "first"),
        Check("one", "longer", 3.0, 2.0, "mm", None, "second"),
        Check("two", "b", 1.0, 2.0, "kg", 1.0, "third", True),
    )
    found = AuditReport(checks)
    assert found.table() == (
        "one\n"
        "  ok   a           0.1235 <= 1        m  at 0.250 s\n"
        "  FAIL longer           3 <= 2        mm\n"
        "two\n"
        "  FAIL b                1 >= 2        kg  at 1.000 s\n"
        "1 of 3 checks passed\n"
        "FAIL longer: second\n"
        "FAIL b: third"
    )
    assert AuditReport(()).table() == "0 of 0 checks passed"
    assert [c.name for c in found.failed] == ["longer", "b"] and not found.passed and found["b"] is checks[2]
    said = json.loads(found.to_json())
    assert said.pop("checks")[1] == {
        "group": "one", "name": "longer", "value": 3.0, "limit": 2.0, "unit": "mm", "time": None, "note": "second",
        "at_least": False, "passed": False}  # fmt: skip
    assert said == {"schema": "jumplab-passport-1", "passed": False, "failed": ["longer", "b"], "manifest": {},
                    "capture": None}  # fmt: skip
    odd = AuditReport((Check("a", "x", math.nan, 9.0, "m", 0.1, "what"),), {"size": np.float64(np.inf)})
    strict = json.loads(odd.to_json(), parse_constant=pytest.fail)
    assert strict["checks"][0]["value"] is None and strict["manifest"]["size"] is None and not strict["passed"]
    assert not AuditReport(()).passed
    with pytest.raises(KeyError):
        found["absent"]
    fast = AuditReport(checks[:1], {}, LIMITS["capture point"].check(0.7))
    words = (
        "but it lands too fast to be caught: the capture point lies 70 % of the CoM's height outside the "
        "soles, over the limit of 27; ask for less distance or rise"
    )
    assert fast.passed and not fast.sound and fast.line() == f"all 1 checks passed; {words}"
    assert fast.table().endswith(f"\n{words}") and json.loads(fast.to_json())["capture"]["value"] == 70
    assert AuditReport(checks[:1], {}, LIMITS["capture point"].check(0.25)).sound and not found.sound


def test_the_notes_carry_what_was_found():
    known, task = truth(1), truth(1).task
    found = audit(known.tape, ROBOT, task)
    travel = np.mean((known.toe[-1] - known.toe[0])[..., 0])
    height = known.com[known.tape.takeoff_index :, 2]
    turned = 1e-3 * known.said["rotation"][0]
    assert f"feet travel {travel:.4f} m from toe to toe, asked -0.3 m; worst: " in found["distance"].note
    assert (
        found["rise"].note == f"CoM rises {np.ptp([height[0], height.max()]):.4f} m from take-off to apex, asked 0.1 m"
    )
    feet = np.degrees(known.turned)
    assert found["rotation"].note.startswith(f"feet turn {feet.mean():.1f} deg about +y over the jump, asked -360 deg")
    assert turned > 0.02 and found["sole on the surface"].note.startswith(
        "farthest sole corner from the surface at 0.25 m"
    )
    assert found["ballistic CoM"].note.endswith(" with g = 9")
    assert f"the energy ranges over {np.ptp(known.energy):.0f} J and" in found["energy balance"].note
    assert "as a share of friction 0.5 on 0.05 m, wherever a foot carries over 50 N" in found["torsional friction"].note
    assert found["foot clearance"].note.startswith(
        "lowest sole point over the surface, 30% to 70% of the flight; worst: "
    )
    assert "while the heel is over 5 mm up, wherever a foot carries over 50 N" in found["CoP at the toe"].note
    lift = known.acceleration[: known.tape.takeoff_index, 2] + known.g
    moved = lift @ known.tape.f[: known.tape.takeoff_index, :, 2].sum(axis=1) / (lift @ lift)
    assert found["mass"].note == (
        f"the ground force moves {moved:.3f} kg (least squares over the launch), the URDF has 42.000 kg"
    )
    assert list(dict.fromkeys(c.group for c in found.checks)) == [
        "tape", "dynamics", "contact", "joints", "target", "collision", "robot"]  # fmt: skip


def test_the_manifest_names_robot_target_and_versions():
    tape = random_tape(0)
    assert audit(tape, ROBOT, TASK).manifest == {
        "robot": "bhr", "robot_hash": ROBOT.hash, "target": TASK.numbers, "samples": 25,
        "versions": versions()}  # fmt: skip
    assert audit(tape, ROBOT).manifest["target"] is None


# ------------------------------------------------------------------------------------------------ the form of a tape


def faults(**changes) -> list[float]:
    """Broken entries, and faults in the order of phases."""
    return [count for _, count in form(dataclasses.replace(random_tape(0), **changes))]


def test_every_fault_of_form_is_counted():
    tape, phases = random_tape(0), random_tape(0).phase
    assert faults() == [0, 0]
    for count, name in enumerate(("t", "q", "v", "a", "tau", "f"), 1):
        array = np.array(getattr(tape, name))
        array.flat[-count:] = np.inf if count % 2 else np.nan
        assert faults(**{name: array})[0] == count
    swap = np.where(phases == "flight", "launch", "flight")
    assert faults(phase=swap) == [0, 1]  # begins in the air
    assert faults(phase=np.where(np.arange(25) == 3, "landing", phases)) == [0, 1]
    # two switches more, two steps that are not zero, and three pieces shorter than ten samples
    assert faults(phase=np.where(np.arange(25) == 3, "flight", phases)) == [0, 7]
    short = {n: getattr(tape, n)[2:-3] for n in ("t", "q", "v", "a", "tau", "f", "phase")}
    assert faults(**short) == [0, 0]  # ten of each are enough
    for rows in (slice(3, None), slice(None, -4)):
        assert faults(**{n: getattr(tape, n)[rows] for n in short}) == [0, 1]
    assert faults(phase=np.full(25, "launch")) == [0, 2]  # no switch to a flight, an instant twice within the launch
    t = np.array(tape.t)
    t[5] = t[4]
    assert faults(t=t) == [0, 1]
    t = np.array(t)
    t[20:] -= 1.0
    assert faults(t=t) == [0, 2]
    t = np.array(tape.t)
    t[12:] += 1e-6  # take-off at two instants
    assert faults(t=t) == [0, 1]
    assert [c.name for c in audit(dataclasses.replace(tape, t=t), ROBOT, TASK).checks] == [
        "finite numbers", "order of phases"]  # fmt: skip


# ------------------------------------------------------------------------------------------------ what is refused


def test_what_is_no_tape_no_robot_and_no_target():
    tape = random_tape(0)
    for arguments, options, sentence in (
        ((3, ROBOT), {}, "tape must be a Tape, got 3"),
        ((tape, "bhr"), {}, "robot must be a Robot, got 'bhr'"),
        ((tape, ROBOT, 1.0), {}, "task must be a JumpTask, got 1.0"),
        ((tape, ROBOT), {"edge_m": "far"}, "edge_m must be a number, got 'far'"),
        ((tape, ROBOT), {"edge_m": True}, "edge_m must be a number, got True"),
        ((tape, ROBOT), {"edge_m": math.nan}, "edge_m must be finite, got nan"),
    ):
        assert refused(audit, *arguments, **options) == sentence
    assert audit(tape, ROBOT, TASK, edge_m=1).checks == audit(tape, ROBOT, TASK, edge_m=1.0).checks


def test_a_tape_of_another_robot_word_for_word():
    tape = random_tape(0)
    n = len(tape.t)
    sizes = {"q": ((n, 21), (n, 20)), "v": ((n, 20), (n, 19)), "a": ((n, 20), (n, 19)), "tau": ((n, 14), (n, 13)),
             "f": ((n, 2, 6), (n, 2, 5))}  # fmt: skip
    for name, (needs, has) in sizes.items():
        said = refused(audit, dataclasses.replace(tape, **{name: getattr(tape, name)[..., :-1]}), ROBOT)
        assert said == f"tape: {name} has shape {has}, the robot 'bhr' needs {needs}"
    cases = {
        "tape: its joints are not those of the robot 'bhr' in the same order; plan the jump again with this robot": {
            "joint_names": tape.joint_names[::-1]
        },
        "tape: the contact frame 'tail' is not a link of the robot 'bhr'": {
            "contact_frames": np.array(["left_foot", "tail"])
        },
        "tape: it names no contact frame, but a jump needs a foot; plan the jump again": {
            "contact_frames": tape.contact_frames[:0], "f": tape.f[:, :0]
        },
    }  # fmt: skip
    for sentence, changes in cases.items():
        assert refused(audit, dataclasses.replace(tape, **changes), ROBOT) == sentence


def test_a_urdf_that_pinocchio_cannot_read():
    tape, broken = random_tape(0), object.__new__(type(ROBOT))
    vars(broken).update(vars(ROBOT))
    object.__setattr__(broken, "urdf", "<robot/>")
    with pytest.raises(RobotError, match=r"^robot bhr: Pinocchio cannot read the URDF: [^\n]+$"):
        open_tape(tape, broken, None)
    missing = LEFT_FOOT.replace('<box size="0.24 0.1 0.03" />', '<mesh filename="none.stl" />')
    object.__setattr__(broken, "urdf", ROBOT.urdf.replace(LEFT_FOOT, missing))
    with pytest.raises(RobotError, match=r"^robot bhr: its collision shapes cannot be read: [^\n]+$"):
        replay(tape, broken, None)


# ------------------------------------------------------------------------------------------------ soles, masses, mirror


def test_soles_are_read_from_the_lowest_boxes_of_each_foot():
    tape = random_tape(0)
    box = '<collision>\n      <origin xyz="0.02 0 -0.06" rpy="0 0 0" />'
    assert box in LEFT_FOOT
    moved = with_foot(box, box.replace("0.02 0 -0.06", "0.025 0.003 -0.061"))
    left, right = replay(tape, moved, None).soles
    assert (left.heel, left.toe, left.right, left.left, left.z) == pytest.approx((-0.095, 0.145, -0.047, 0.053, -0.076))
    assert (right.heel, right.toe, right.right, right.left, right.z) == pytest.approx((-0.1, 0.14, -0.05, 0.05, -0.075))
    assert audit(tape, moved, TASK)["sole as in the URDF"].value == pytest.approx(5.0)  # the worse foot's worst number
    second = LEFT_FOOT.replace("</link>", """<collision><origin xyz="0.2 0 -0.0695" rpy="0 0 0" />
      <geometry><box size="0.04 0.02 0.01" /></geometry></collision></link>""")  # fmt: skip
    longer = robot_with(urdf=(LEFT_FOOT, second))  # half a millimetre higher: part of the sole
    assert replay(tape, longer, None).soles[0].toe == pytest.approx(0.22)
    higher = robot_with(urdf=(LEFT_FOOT, second.replace("-0.0695", "-0.068")))  # two: not
    assert replay(tape, higher, None).soles[0].toe == pytest.approx(0.14)
    bare = with_foot('<box size="0.24 0.1 0.03" />\n      </geometry>\n    </collision>',
                     '<sphere radius="0.01" />\n      </geometry>\n    </collision>')  # fmt: skip
    said = replay(tape, bare, None).soles[0]  # no box: what the configuration says
    assert (said.heel, said.toe, said.right, said.left, said.z) == (-0.1, 0.14, -0.05, 0.05, -0.075)


def test_links_without_mass_are_counted_and_named():
    tape, mass = random_tape(0), '<mass value="1" />'
    assert audit(tape, ROBOT)["links have mass"].note.endswith(" MuJoCo refuses: none")
    for other in ("", '<mass value="0" />', "<mass />"):
        found = audit(tape, with_foot(mass, other))["links have mass"]
        assert found.value == 1 and found.note.endswith(": left_foot") and not found.passed
    both = dataclasses.replace(ROBOT, urdf=ROBOT.urdf.replace(mass, '<mass value="0" />'))
    assert audit(tape, both)["links have mass"].note.endswith(": left_foot, right_foot")
    light = with_foot(mass, '<mass value="0.5" />')
    assert audit(tape, light)["links have mass"].value == 0


def test_mirrored_joints_by_name():
    model, _ = open_tape(random_tape(0), ROBOT, None)
    other, sign = mirror(model)
    swap = {"left": "right", "right": "left"}
    for name, k, s in zip(JOINTS, other, sign, strict=True):
        side, rest = name.split("_", 1)
        assert JOINTS[k] == f"{swap[side]}_{rest}" and s == (-1.0 if rest.endswith(("yaw", "roll")) else 1.0)
    ahead = ROBOT.urdf
    for side in ("-0.1", "0.1"):
        assert f'<origin xyz="0 {side} -0.43"' in ahead
        ahead = ahead.replace(f'<origin xyz="0 {side} -0.43"', f'<origin xyz="0.02 {side} -0.43"')
    np.testing.assert_array_equal(mirror(pin.buildModelFromXML(ahead, pin.JointModelFreeFlyer())), (other, sign))
    one = ahead.replace('<origin xyz="0.02 0.1 -0.43"', '<origin xyz="-0.02 0.1 -0.43"')
    assert mirror(pin.buildModelFromXML(one, pin.JointModelFreeFlyer())) is None
    lopsided = robot_with(urdf=('<origin xyz="0 0.23 0"', '<origin xyz="0 0.25 0"'))
    assert "left/right posture" not in [check.name for check in audit(random_tape(0), lopsided).checks]


def test_the_step_between_two_surfaces_may_be_given():
    """Sample by sample: the height under a sole jumps at edge_m ahead of the toes' first place."""
    known = truth(1)
    r = replay(known.tape, ROBOT, known.task, edge_m=-0.15)
    edge = known.sole[0, ..., 0].mean() + ROBOT.foot.toe - ROBOT.foot.center[0] - 0.15
    assert r.edge == pytest.approx(edge) and r.heading == known.ahead
    ahead = known.ahead
    assert list(r.surface(edge + ahead * np.array([-1e-3, 1e-3]))) == [0.0, known.task.platform_m]
    level = audit(known.tape, ROBOT, dataclasses.replace(known.task, platform_m=0.0))
    assert level["body clearance"].note.endswith(" - ground")


def test_quotients_of_almost_nothing():
    """A robot that stays, that keeps its speed, or that hardly accelerates: no division by zero, no other number."""
    tape, still = random_tape(0), {n: np.zeros_like(getattr(random_tape(0), n)) for n in ("v", "a", "f", "tau")}
    q = np.tile(tape.q[:1], (len(tape.t), 1))
    statue = audit(dataclasses.replace(tape, q=q, **still), ROBOT)
    fallen = 42.0 * 9.8 * tape.t[11]
    assert replay(dataclasses.replace(tape, q=q, **still), ROBOT, None).heading == 1.0  # on the spot
    assert statue["linear impulse"].value == pytest.approx(100 * fallen / 1e-9)
    assert statue["mass"].value == pytest.approx(100)  # no force moves nothing
    for name in ("torsional friction", "CoP at the toe", "friction used"):
        assert statue[name].value == 0.0
    assert statue["CoP in the sole"].note.endswith(" (nothing to check)") and statue["CoP in the sole"].passed
    same = audit(dataclasses.replace(tape, q=q, **{**still, "v": np.ones_like(tape.v), "tau": tape.tau}), ROBOT)
    power = tape.tau.sum(axis=1)
    work = np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(tape.t))
    assert same["energy balance"].value == pytest.approx(100 * np.abs(work).max() / 1e-9, rel=1e-3)
    soft, model = np.zeros_like(tape.a), ROBOT.model
    upright = pin.integrate(model, stance_configuration(ROBOT), np.zeros(model.nv))
    turn = pin.Quaternion(upright[3:7]).matrix()
    soft[:, :3] = turn.T @ [0.0, 0.0, -9.7]  # all but free fall
    push = np.zeros_like(tape.f)
    push[:, :, 2] = 1.0
    slow = dataclasses.replace(tape, q=np.tile(upright, (len(tape.t), 1)), **{**still, "a": soft, "f": push})
    assert audit(slow, ROBOT)["mass"].note.startswith("the ground force moves 20.000 kg")


def pressed(point, pitch: float = 0.0, roll: float = 0.0, lift: float = 0.0, force: float = 200.0):
    """A tape with one force [N], in one row, at a point of the left sole [m] whose lower heel end is lifted [m]."""
    tape, row = random_tape(0), 3
    q, f = np.array(tape.q), np.zeros_like(tape.f)
    q[row] = stance_configuration(ROBOT)
    for name, angle in (("left_ankle_pitch", pitch), ("left_ankle_roll", roll)):
        q[row, 7 + JOINTS.index(name)] += angle
    before = replay(dataclasses.replace(tape, q=q.copy()), ROBOT, None)
    q[row, 2] += lift - before.heel_corners[row, 0, :, 2].min()
    place = before.foot_rotation[row, 0] @ point
    origin = before.foot[row, 0] + [0, 0, q[row, 2] - before.tape.q[row, 2]]
    place[2] = -origin[2]  # on the ground
    f[row, 0] = [0, 0, force, *np.cross(place, [0, 0, force])]
    return audit(dataclasses.replace(tape, q=q, f=f), ROBOT)


def test_a_foot_is_tipped_when_both_ends_of_its_heel_are_up():
    """The heel's lower end counts, 5 mm and not a hair less, whichever side it is on."""
    for roll in (0.1, -0.1):
        tipped = [pressed(np.zeros(3), 0.1, roll, lift)["CoP at the toe"].value for lift in (0.0049, 0.0051)]
        assert tipped[0] == 0.0 and 125 < tipped[1] < 145


def test_pressure_beyond_each_edge_of_the_sole():
    foot = ROBOT.foot
    for x, y, beyond in ((foot.toe + 0.02, 0, 20), (foot.heel - 0.03, 0, 30), (0, foot.half_width + 0.04, 40),
                         (0, -foot.half_width - 0.05, 50), (0, 0, -50), (foot.toe - 0.01, 0, -10),
                         (foot.heel + 0.02, 0.01, -20)):  # fmt: skip
        found = pressed(np.array([x, y, 0.0]))["CoP in the sole"]
        assert found.value == pytest.approx(beyond, abs=1e-6) and found.note.endswith("; worst: left_foot")
    assert pressed(np.array([1.0, 0, 0]), force=50.0)["CoP in the sole"].note.endswith(" (nothing to check)")


def test_torque_left_counts_the_sign_of_the_power_alone():
    tape, knee, limits = random_tape(0), JOINTS.index("left_knee"), ROBOT.actuators["left_knee"]
    v, tau = np.array(tape.v), np.array(tape.tau)
    v[:3, 6 + knee], tau[:3, knee] = limits["speed"], [1e-3, -1e-3, 0.0]
    left = available_torque(replay(dataclasses.replace(tape, v=v, tau=tau), ROBOT, None))[:3, knee]
    np.testing.assert_allclose(left, limits["effort"] * np.array([0.01, 1.0, 1.0]))
    steep = robot_with(config=("corner_speed_ratio = 0.5", "corner_speed_ratio = 0.98"))  # 19.6 to 20 rad/s
    v, tau = v.copy(), tau.copy()
    v[0, 6 + knee], tau[0, knee] = 0.99 * limits["speed"], 1.0
    left = available_torque(replay(dataclasses.replace(tape, v=v, tau=tau), steep, None))[0, knee]
    assert left == pytest.approx(limits["effort"] / 2)


def test_symmetry_names_what_is_worst():
    tape = random_tape(0)
    still = {"tau": np.zeros_like(tape.tau), "f": np.zeros_like(tape.f)}
    for column, both, name in ((1, 1.0, "lateral force"), (2, -1.0, "foot load")):
        f = np.zeros_like(tape.f)
        f[4, :, column] = [10.0, both * 10.0]
        found = audit(dataclasses.replace(tape, **{**still, "f": f}), ROBOT)["left/right effort"]
        assert found.note.endswith(f"; worst: {name}") and found.value == pytest.approx(100 * 20 / (42 * 9.8))
    q = np.tile(stance_configuration(ROBOT), (len(tape.t), 1))
    for column, value, name in ((1, 0.03, "lateral shift"), (3, 0.1, "roll"), (5, 0.1, "yaw")):
        other = q.copy()
        other[4, column] += value
        found = audit(dataclasses.replace(tape, q=other), ROBOT)["left/right posture"]
        amount = 1e3 * value * (1 if column == 1 else 2)
        assert found.note.endswith(f"; worst: {name}") and found.value == pytest.approx(amount)


# ------------------------------------------------------------------------------------------------ folders


def test_a_folders_target_edge_and_place(tmp_path):
    tape = random_tape(0)
    task = JumpTask(0.4, 0.1, platform_m=0.3)
    summary = {"target": dataclasses.asdict(task) | {"unknown": 3}, "platform_edge_m": 0.123}
    store.write_plan(tmp_path, tape, ROBOT, summary)
    found = write_audit(tmp_path)
    assert len(found.manifest["plan_sha256"]) == 64 and found.manifest["robot_hash"] == ROBOT.hash
    assert found.checks == audit(tape, ROBOT, task, edge_m=0.123).checks != audit(tape, ROBOT, task).checks
    assert json.loads((tmp_path / "passport.json").read_text())["manifest"]["planner"]["platform_edge_m"] == 0.123
    (tmp_path / "robot.urdf").unlink()
    with pytest.raises(InputError, match=r"^the plan in .* cannot be read \(No such file or directory\)$"):
        write_audit(tmp_path)
    store.write_plan(tmp_path, tape, ROBOT, {"target": {"distance_m": 1.0}})
    assert refused(write_audit, tmp_path) == "a target has a distance_m and a height_m; plan the jump again"
    assert not (tmp_path / "passport.json").exists()
