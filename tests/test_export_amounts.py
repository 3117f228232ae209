"""Exports of a motion of 20 ms and of random numbers: every column, name and sentence, a few ms each."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import refused
from scipy.spatial.transform import Rotation

from jumplab.cli.common import CHOICES
from jumplab.errors import InputError
from jumplab.io import export
from jumplab.io.motion import Motion, read_simulation, steady
from jumplab.io.whole import ORDERS, Whole, ordered
from jumplab.robot import Robot
from jumplab.robot.stance import stance_configuration

ROBOT = Robot.load()
JOINTS, MODEL = ROBOT.joint_names, ROBOT.model
SWITCH, LAST = 10, 22  # rows: take-off's first sample, and the end of the motion


@cache
def short() -> Motion:
    """From 0.5 s on, every millisecond; take-off stands twice, and the last sample half a millisecond later."""
    rng = np.random.default_rng(5)
    steps = np.array([*np.arange(11), *np.arange(10, 21), 20.5])
    q = [pin.integrate(MODEL, stance_configuration(ROBOT), rng.normal(0, 0.2, MODEL.nv))]
    for _ in steps[1:]:
        q.append(pin.integrate(MODEL, q[-1], rng.normal(0, 0.02, MODEL.nv)))
    q = np.array(q)
    q[3:7, 3:7] *= -1  # the same attitudes
    phase = np.array(["launch"] * 11 + ["flight"] * 8 + ["landing"] * 4)
    v, tau = rng.normal(0, 3, (len(steps), MODEL.nv)), rng.normal(0, 50, (len(steps), MODEL.nv - 6))
    return Motion(0.5 + steps / 1000, q, v, tau, phase, "plan")


ROWS = [*range(SWITCH), *range(SWITCH + 1, LAST)]  # on a grid of 1 ms: take-off once, the later sample; no half ones
WHOLE = Whole(ROBOT)
AT = [JOINTS.index(name) for name in WHOLE.joints]  # of the joints in the URDF's order, in Pinocchio's


def frames(rate: float, motion: Motion | None = None):
    return WHOLE.frames(motion or short(), rate)


# tables and arrays ----------------------------------------------------------------------------------------------
def test_every_number_of_the_joint_table():
    motion, lines = short(), export.joint_table(WHOLE, frames(1000.0), 1000.0).splitlines()
    kinds = {"position_rad": motion.q[:, 7:], "velocity_rad_s": motion.v[:, 6:], "torque_N_m": motion.tau}
    head = [f"{name}_{kind}" for kind in kinds for name in WHOLE.joints]
    base = [f"base_{x}" for x in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    com = [f"com_{x}_m" for x in "xyz"]
    model, data = WHOLE.robot.model, WHOLE.robot.model.createData()
    kinds["base"] = motion.q[:, :7] * np.where(np.arange(7) > 2, np.sign(motion.q[:, 6:7]), 1.0)  # w is positive
    assert lines[0].split(",") == [
        "time_s", "phase_0_launch_1_flight_2_landing", "contact_left", "contact_right", *head, *base, *com]  # fmt: skip
    assert len(lines) == 23  # the last whole millisecond, and the end half a one later
    for k, (line, row) in enumerate(zip(lines[1:], [*ROWS, LAST], strict=True)):
        said = line.split(",")
        assert said[0] == ("0.020500" if row == LAST else f"{k / 1000:.6f}")
        assert said[1] == {"launch": "0", "flight": "1", "landing": "2"}[motion.phase[row]]
        assert said[2:4] == ["0" if motion.phase[row] == "flight" else "1"] * 2
        rows = [x[row] if name == "base" else x[row][AT] for name, x in kinds.items()]
        rows.append(pin.centerOfMass(model, data, motion.q[row]))
        np.testing.assert_allclose(np.array(said[4:], float), np.concatenate(rows), rtol=6e-9, atol=1e-12)
    assert max(len(x) for x in lines[1].split(",")[4:]) >= 10  # nine digits


# clips ----------------------------------------------------------------------------------------------------------
KEYS = ["fps", "joint_pos", "joint_vel", "joint_torque", "body_pos_w", "body_quat_w", "body_lin_vel_w",
        "body_ang_vel_w", "contact", "phase", "joint_names", "body_names"]  # fmt: skip


def test_what_no_format_says_of_places():
    """Torques, phases, names and kinds of numbers; places and speeds are compared with MuJoCo's in test_export."""
    x = frames(500.0)
    plain, clip, root = (make(WHOLE, x, 500.0) for make in (export.plain_arrays, export.tracked, export.with_root))
    lists = export.retargeted(WHOLE, x, 500.0)
    for arrays, name in ((plain, "joint_torque_N_m"), (clip, "joint_torque"), (root, "joint_torque")):
        np.testing.assert_allclose(arrays[name], short().tau[[*ROWS[::2], LAST]][:, AT], rtol=1e-6)
        assert list(arrays["phase"]) == lists["phase"] == list(short().phase[[*ROWS[::2], LAST]])
        assert list(arrays["joint_names"]) == list(WHOLE.joints) and arrays["contact"].dtype == bool
    assert list(clip) == list(root) == KEYS and {clip[k].dtype for k in KEYS[1:8]} == {np.dtype(np.float32)}
    assert list(root["body_names"]) == ["world", *WHOLE.links] and root["joint_pos"].dtype == np.float32
    for name, still in zip(KEYS[4:8], ([0] * 3, [1, 0, 0, 0], [0] * 3, [0] * 3), strict=True):
        assert (root[name][:, 0] == still).all()
    assert clip["fps"].dtype == np.int64 and list(export.tracked(WHOLE, frames(12.5), 12.5)["fps"]) == [12.5]
    assert plain["time_s"] == pytest.approx([*np.arange(len(x.t) - 1) / 500, 0.0205]) and lists["fps"] == 500.0
    assert lists["link_body_list"] == list(WHOLE.links) and (lists["dof_torque"] == x.tau).all()


TREE = """<robot name="x">
<link name="end"/><link name="root"/><link name="b"/><link name="a"/><link name="a1"/><link name="b1"/>
<joint name="jb" type="revolute"><parent link="root"/><child link="b"/></joint>
<joint name="ja" type="fixed"><parent link="root"/><child link="a"/></joint>
<joint name="ja1" type="revolute"><parent link="a"/><child link="a1"/></joint>
<joint name="jb1" type="revolute"><parent link="b"/><child link="b1"/></joint>
<joint name="je" type="revolute"><parent link="b1"/><child link="end"/></joint>
</robot>"""


def test_links_in_both_orders():
    deep, broad = (ordered(TREE, order) for order in ORDERS)
    assert deep == (("jb", "jb1", "je", "ja1"), ("root", "b", "b1", "end", "a1"))  # a is fixed to the root
    assert broad == (("jb", "jb1", "ja1", "je"), ("root", "b", "b1", "a1", "end"))
    one, other = (export.tracked(WHOLE, frames(50.0), 50.0, order=order) for order in ORDERS)
    for names, array in (("joint_names", "joint_vel"), ("joint_names", "joint_torque"), ("body_names", "body_quat_w")):
        order = [list(one[names]).index(n) for n in other[names]]
        assert order != sorted(order)
        np.testing.assert_array_equal(one[array][:, order], other[array])
    assert len(one["joint_pos"]) == 3 and list(one["fps"]) == [50]  # 0, 20 and 20.5 ms


# files ----------------------------------------------------------------------------------------------------------
NAMES = {"csv": "joints.csv", "npz": "motion.npz", "urdf-replay": "replay", "unitree-csv": "unitree.csv",
         "gmr-pkl": "gmr.pkl", "mjlab-npz": "mjlab.npz", "beyondmimic-npz": "beyondmimic.npz",
         "holosoma-npz": "holosoma.npz", "unilab-npz": "unilab.npz",
         "protomotions": "protomotions.motion", "isaaclab-npz": "isaaclab.npz", "asap-pkl": "asap.pkl",
         "sonic-pkl": "sonic.pkl", "bones-csv": "bones.csv", "mujoco": "mujoco"}  # fmt: skip


def test_files_and_their_names(tmp_path):
    assert {k: export.default_name(k, "plan") for k in export.FORMATS} == NAMES
    assert {k: export.default_name(k, "simulation") for k in NAMES} == {k: f"simulated_{x}" for k, x in NAMES.items()}
    assert CHOICES["formats"] == list(NAMES) == list(export.FORMATS)
    assert refused(export.write, "bvh", short(), ROBOT, tmp_path / "x") == (
        f"format 'bvh': must be one of {', '.join(NAMES)}"
    )
    for name, ending in (("csv", ".csv"), ("gmr-pkl", ".pkl"), ("mjlab-npz", ".npz")):
        assert refused(export.write, name, short(), ROBOT, tmp_path / "x.txt") == (
            f"--out must name a file that ends in {ending}, got {str(tmp_path / 'x.txt')!r}"
        )
    path = export.write("csv", short(), ROBOT, str(tmp_path / "LOUD.CSV"))
    assert path == tmp_path / "LOUD.CSV" and path.read_text() == export.joint_table(WHOLE, frames(1000.0), 1000.0)
    for name, arrays, fps in (
        ("npz", export.plain_arrays(WHOLE, frames(1000.0), 1000.0), None),
        ("mjlab-npz", export.tracked(WHOLE, frames(50.0), 50.0), None),
        ("mjlab-npz", export.tracked(WHOLE, frames(250.0), 250.0), 250),
        ("beyondmimic-npz", export.tracked(WHOLE, frames(50.0), 50.0, order=ORDERS[1], at_com=True), None),
        ("holosoma-npz", export.with_root(WHOLE, frames(50), 50), None),
        ("unilab-npz", export.with_world(WHOLE, frames(50), 50), None),
    ):
        path = export.write(name, short(), ROBOT, tmp_path / "x.npz", fps=fps)
        raw = sum(x.nbytes for x in arrays.values())
        with np.load(path, allow_pickle=False) as file:
            assert file.files == list(arrays)
            for key, x in arrays.items():
                np.testing.assert_array_equal(file[key], x)
        assert path.stat().st_size < raw + 300 * len(arrays)  # compressed
    path, x = export.write("unitree-csv", short(), ROBOT, tmp_path / "x.csv"), frames(30.0)
    states = np.hstack([x.q[:, :3], x.q[:, 3:7], x.q[:, 7:]])
    expected = "".join(",".join(f"{v:.9g}" for v in state) + "\n" for state in states)
    assert path.read_text() == expected  # no line of names
    raw = export.write("gmr-pkl", short(), ROBOT, tmp_path / "x.pkl").read_bytes()
    assert raw[:2] == b"\x80\x04"  # the protocol that every Python 3 in use reads
    for key, values in export.retargeted(WHOLE, x, 30.0).items():
        np.testing.assert_array_equal(pickle.loads(raw)[key], values)
    ((name, entry),) = pickle.loads(
        export.write("sonic-pkl", short(), ROBOT, tmp_path / "hop.pkl").read_bytes()
    ).items()
    assert name == "hop" and entry["fps"] == 50 and isinstance(entry["fps"], int)  # the file's name
    with pytest.raises(InputError, match="the format has no joints called 'knee'"):
        export.library_entry(WHOLE, frames(50.0), 50.0, without="knee")
    odd = export.tracked(WHOLE, frames(29.97), 29.97)["fps"]
    assert odd.tolist() == [29.97] and export.tracked(WHOLE, frames(50.0), 50.0)["fps"].dtype == np.int64
    rates = {name: rate for name, (_, rate) in export.FORMATS.items()}
    assert rates == {"csv": 1000, "npz": 1000, "urdf-replay": 100, "unitree-csv": 30, "gmr-pkl": 30, "mjlab-npz": 50,
                     "beyondmimic-npz": 50, "holosoma-npz": 50, "unilab-npz": 50, "protomotions": 30,
                     "isaaclab-npz": 50, "asap-pkl": 30, "sonic-pkl": 50,
                     "bones-csv": 120, "mujoco": 1000}  # fmt: skip


def test_the_folder_of_a_replay(tmp_path):
    folder = tmp_path / "replay"
    assert export.write("urdf-replay", replace(short(), source="simulation"), ROBOT, folder) == folder
    assert sorted(p.name for p in folder.iterdir()) == ["README.md", "replay.py", "robot.urdf", "trajectory.npz"]
    assert (folder / "robot.urdf").read_text() == ROBOT.urdf
    readme, script = (folder / "README.md").read_text(), (folder / "replay.py").read_text()
    assert re.search(r"```python\n(.*?)\n```", readme, re.S)[1] == script.strip()
    assert "@@" not in readme and "simulation" in readme and ROBOT.name in readme
    arrays = export.plain_arrays(WHOLE, frames(100.0), 100.0)
    with np.load(folder / "trajectory.npz") as file:
        assert file.files == ["hz", *arrays] and file["hz"] == 100.0
        for key, x in arrays.items():
            np.testing.assert_array_equal(file[key], x)
    for mine in (".staging", ".commit"):  # what a killed writer leaves is no stranger's
        (folder / mine).mkdir(exist_ok=True)
    export.write("urdf-replay", short(), ROBOT, folder)
    assert "simulation" not in (folder / "README.md").read_text()
    for name in ("thesis.tex", "notes.txt"):
        (folder / name).write_text("mine")
    assert refused(export.write, "urdf-replay", short(), ROBOT, folder) == (
        f"the folder {str(folder)!r} already holds 'notes.txt'; choose a new or an empty one"
    )


# motions --------------------------------------------------------------------------------------------------------
def test_between_samples():
    motion = short()
    x = motion.at([0.5, 0.50025, 0.5095, 0.51, 0.51025, 0.5204, 0.5205])
    low = [0, 0, 9, 11, 11, 21, 21]
    share = np.array([0.0, 0.25, 0.5, 0.0, 0.25, 0.8, 1.0])
    for name in ("v", "tau"):
        values = getattr(motion, name)
        expected = [values[k] + s * (values[k + 1] - values[k]) for k, s in zip(low, share, strict=True)]
        np.testing.assert_allclose(getattr(x, name), expected, rtol=1e-9, atol=1e-9)
    for i, (k, s) in enumerate(zip(low, share, strict=True)):
        between = pin.interpolate(MODEL, motion.q[k], motion.q[k + 1], s)
        np.testing.assert_allclose(x.q[i, 7:], between[7:], atol=1e-12)
        np.testing.assert_allclose(x.q[i, :3], motion.q[k, :3] + s * (motion.q[k + 1] - motion.q[k])[:3], atol=1e-12)
        same = x.q[i, 3:7] @ between[3:7]
        assert abs(same) == pytest.approx(1.0, abs=1e-12)
    assert list(x.phase) == ["launch", "launch", "launch", "flight", "flight", "landing", "landing"]
    assert x.source == "plan" and motion.duration == pytest.approx(0.0205)
    assert x.contact.tolist() == [[phase != "flight"] * 2 for phase in x.phase]
    assert len(motion.at([]).t) == 0
    assert motion.at([0.5205 + 0.9e-9]).tau[0] == pytest.approx(motion.tau[-1])
    for outside in ([0.4999, 0.51], [0.51, 0.5205 + 2e-9]):
        first, last = (f"{x:g}" for x in outside)
        assert refused(motion.at, outside) == (f"times {first} ... {last} s are outside the motion, 0.5 ... 0.5205 s")


def test_the_end_may_stand_twice():
    motion = short()
    double = replace(motion, t=np.append(motion.t[:-1], motion.t[-2]))
    x = double.at([double.t[-1]])
    np.testing.assert_allclose(x.tau[0], motion.tau[-1], rtol=1e-12)
    assert x.phase[0] == "landing" and len(double.every(1000.0).t) == 21


def test_grids():
    motion = short()
    assert list(motion.every(10_000.0).t) == pytest.approx(0.5 + np.arange(206) / 10_000)
    assert len(motion.every(2000.0).t) == 42  # the last sample lies on it
    assert list(motion.every(0.5).t) == [0.5] and list(motion.every(0.5, end=True).t) == [0.5, motion.t[-1]]
    assert len(motion.every(2000.0, end=True).t) == 42  # once
    rounded = replace(motion, t=np.append(motion.t[:-1], 0.5205 - 1e-10))
    assert rounded.every(2000.0).t[-1] == rounded.t[-1]
    for rate in (np.nan, np.inf):
        assert refused(motion.every, rate) == f"rate_hz must be finite, got {rate:g}"
    for rate in (0.0, -1.0, 10_000.1):
        assert refused(motion.every, rate) == (f"rate = {rate:g} per second must lie above 0 and not above 10000")


def test_signs_of_quaternions():
    turns = Rotation.from_rotvec(np.linspace(0, 6, 30)[:, None] * np.array([[[0.3, -0.7, 0.6]]])[0]).as_quat()
    signs = np.where(np.random.default_rng(2).uniform(size=(30, 2)) < 0.5, -1.0, 1.0)
    found = steady(signs[..., None] * turns[:, None])
    np.testing.assert_allclose(found, signs[:1, :, None] * steady(turns)[:, None])
    assert (np.sum(found[1:] * found[:-1], axis=-1) > 0).all()
    right = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]])
    np.testing.assert_array_equal(steady(right), right)  # at right angles, signs stay


def test_where_a_motion_comes_from(tmp_path):
    record = SimpleNamespace(**{k: getattr(short(), k) for k in ("t", "q", "v", "tau", "phase")})
    assert Motion.of(record).source == "simulation" and Motion.of(record).tau is short().tau
    wrench = np.zeros((len(short().t), 2, 6))
    wrench[3, 0, 2], wrench[4, 1, 2], wrench[5, :, 1] = 5.1, 5.0, 900.0  # a few newtons of what presses
    record.foot_wrench = wrench
    assert np.argwhere(Motion.of(record).contact).tolist() == [[3, 0]]
    del record.foot_wrench
    record.a = short().v
    assert Motion.of(record).source == "plan" and Motion.of(record).contact[0].all()
    record.f = wrench  # of a plan, its phases say what presses
    assert Motion.of(record).wrench is wrench
    pressing = [[phase != "flight"] * 2 for phase in ("launch",) * 11 + ("flight",) * 8 + ("landing",) * 4]
    assert Motion.of(record).contact.tolist() == pressing
    assert refused(Motion.of_simulation_file, tmp_path, ROBOT) == (
        f"{str(tmp_path)!r} holds no simulation; run 'jumplab simulate {tmp_path}' first"
    )
    good = {k: getattr(short(), k) for k in ("t", "q", "v", "tau", "phase")}
    good |= {"schema": np.array("jumplab-simulation-1"), "joint_names": np.array(JOINTS), "more": np.arange(3)}
    good |= {"foot_wrench": wrench}
    path = tmp_path / "simulation.npz"
    np.savez(path, **good)
    back = Motion.of_simulation_file(tmp_path, ROBOT)
    assert back.source == "simulation" and np.argwhere(back.contact).tolist() == [[3, 0]]
    np.testing.assert_array_equal(back.wrench, wrench)
    for name in ("t", "q", "v", "tau", "phase"):
        np.testing.assert_array_equal(getattr(back, name), good[name])
    assert list(read_simulation(str(tmp_path), ROBOT, ("more", "t", "q", "v", "tau", "phase"))["more"]) == [0, 1, 2]
    foreign = f"{path}: not a simulation of this folder's robot; simulate the plan again"
    wrong = {"q": good["q"][:, 1:], "v": good["v"][1:], "tau": good["tau"][:, 1:], "phase": good["phase"][1:],
             "foot_wrench": wrench[1:],
             "schema": np.array("x"), "joint_names": good["joint_names"][::-1], "t": good["t"][None]}  # fmt: skip
    for name, value in wrong.items():
        np.savez(path, **(good | {name: value}))
        assert refused(Motion.of_simulation_file, tmp_path, ROBOT) == foreign
    np.savez(path, **{k: x for k, x in good.items() if k != "tau"})
    assert refused(Motion.of_simulation_file, tmp_path, ROBOT) == (
        f"{path}: not a readable simulation (KeyError); simulate the plan again"
    )
    np.savez(path, **(good | {"t": good["t"].astype(object)}))
    assert "not a readable simulation (ValueError)" in refused(Motion.of_simulation_file, tmp_path, ROBOT)
    path.write_bytes(path.read_bytes()[:200])
    assert "not a readable simulation" in refused(Motion.of_simulation_file, tmp_path, ROBOT)
    with pytest.raises(AttributeError):
        back.source = "plan"
