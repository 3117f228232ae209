"""Exports of a motion of 20 ms and of random numbers: every column, name and sentence, a few ms each."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from test_robot import with_free_base

from jumplab.errors import InputError
from jumplab.io import export
from jumplab.io.motion import Motion, read_simulation, steady
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


def refused(call) -> str:
    with pytest.raises(InputError) as e:
        call()
    return str(e.value)


# tables and arrays ----------------------------------------------------------------------------------------------
def test_every_number_of_the_joint_table():
    motion, lines = short(), export.joint_table(short(), ROBOT).splitlines()
    kinds = {"position_rad": motion.q[:, 7:], "velocity_rad_s": motion.v[:, 6:], "torque_N_m": motion.tau}
    head = [f"{name}_{kind}" for kind in kinds for name in JOINTS]
    assert lines[0].split(",") == ["time_s", "phase_0_launch_1_flight_2_landing", *head]
    assert len(lines) == 22
    for k, (line, row) in enumerate(zip(lines[1:], ROWS, strict=True)):
        said = line.split(",")
        assert said[0] == f"{k / 1000:.6f}"
        assert said[1] == {"launch": "0", "flight": "1", "landing": "2"}[motion.phase[row]]
        np.testing.assert_allclose(
            np.array(said[2:], float), np.concatenate([x[row] for x in kinds.values()]), rtol=6e-9
        )
    assert max(len(x) for x in lines[1].split(",")[2:]) >= 10  # nine digits


def test_every_plain_array():
    motion = short()
    for rate, rows in ((1000.0, ROWS), (500.0, ROWS[::2])):
        x = export.plain_arrays(motion, ROBOT, rate) if rate != 1000.0 else export.plain_arrays(motion, ROBOT)
        turn = Rotation.from_quat(motion.q[rows, 3:7])
        expected = {
            "time_s": np.arange(len(rows)) / rate, "phase": motion.phase[rows], "joint_names": np.array(JOINTS),
            "base_position_m": motion.q[rows, :3], "base_quaternion_xyzw": turn.as_quat(),
            "base_velocity_world_m_s": turn.apply(motion.v[rows, :3]),
            "base_angular_velocity_world_rad_s": turn.apply(motion.v[rows, 3:6]),
            "joint_position_rad": motion.q[rows, 7:], "joint_velocity_rad_s": motion.v[rows, 6:],
            "joint_torque_N_m": motion.tau[rows]}  # fmt: skip
        assert list(x) == list(expected)
        for name, values in expected.items():
            if name == "base_quaternion_xyzw":
                np.testing.assert_allclose(Rotation.from_quat(x[name]).as_matrix(), turn.as_matrix(), atol=1e-9)
                assert (np.sum(x[name][1:] * x[name][:-1], axis=1) > 0).all()
            elif values.dtype.kind == "U":
                assert list(x[name]) == list(values), name
            else:
                np.testing.assert_allclose(x[name], values, rtol=1e-9, atol=1e-9, err_msg=name)


# clips ----------------------------------------------------------------------------------------------------------
def test_a_clip_is_what_mujoco_finds():
    motion, clip = short(), export.motion_clip(short(), ROBOT, fps=500)
    assert list(clip) == ["fps", "joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w",
                          "body_ang_vel_w", "joint_names", "body_names"]  # fmt: skip
    assert clip["fps"].dtype == np.int64 and list(clip["fps"]) == [500]
    assert {clip[k].dtype for k in list(clip)[1:7]} == {np.dtype(np.float32)}
    model = mujoco.MjModel.from_xml_string(with_free_base(ROBOT.urdf))
    data, twist = mujoco.MjData(model), np.zeros(6)
    assert [model.body(i).name for i in range(1, model.nbody)] == list(clip["body_names"])
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    assert joints == list(clip["joint_names"]) and sorted(joints) == sorted(JOINTS)
    at = [JOINTS.index(name) for name in joints]
    assert len(clip["joint_pos"]) == 11
    for k, row in enumerate(ROWS[::2]):
        np.testing.assert_allclose(clip["joint_pos"][k], motion.q[row, 7:][at], atol=1e-6)
        np.testing.assert_allclose(clip["joint_vel"][k], motion.v[row, 6:][at], atol=1e-6)
        x, y, z, w = motion.q[row, 3:7]
        turn = Rotation.from_quat([x, y, z, w])
        data.qpos[:] = np.concatenate([motion.q[row, :3], [w, x, y, z], motion.q[row, 7:][at]])
        data.qvel[:] = np.concatenate([turn.apply(motion.v[row, :3]), motion.v[row, 3:6], motion.v[row, 6:][at]])
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(clip["body_pos_w"][k], data.xpos[1:], atol=2e-6)
        for i in range(1, model.nbody):
            same = clip["body_quat_w"][k, i - 1] @ data.xquat[i]
            assert abs(same) == pytest.approx(1.0, abs=1e-6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, i, twist, 0)
            np.testing.assert_allclose(clip["body_ang_vel_w"][k, i - 1], twist[:3], atol=2e-5)
            np.testing.assert_allclose(clip["body_lin_vel_w"][k, i - 1], twist[3:], atol=2e-5)
    assert (np.sum(clip["body_quat_w"][1:] * clip["body_quat_w"][:-1], axis=-1) > 0).all()


TREE = """<robot name="x">
<link name="end"/><link name="root"/><link name="b"/><link name="a"/><link name="a1"/><link name="b1"/>
<joint name="jb" type="revolute"><parent link="root"/><child link="b"/></joint>
<joint name="ja" type="fixed"><parent link="root"/><child link="a"/></joint>
<joint name="ja1" type="revolute"><parent link="a"/><child link="a1"/></joint>
<joint name="jb1" type="revolute"><parent link="b"/><child link="b1"/></joint>
<joint name="je" type="revolute"><parent link="b1"/><child link="end"/></joint>
</robot>"""


def test_links_in_both_orders():
    robot = SimpleNamespace(urdf=TREE)
    assert export._walk(robot, "depth-first") == [
        ("root", None), ("b", "jb"), ("b1", "jb1"), ("end", "je"), ("a", "ja"), ("a1", "ja1")]  # fmt: skip
    assert export._walk(robot, "breadth-first") == [
        ("root", None), ("b", "jb"), ("a", "ja"), ("b1", "jb1"), ("a1", "ja1"), ("end", "je")]  # fmt: skip
    assert refused(lambda: export._walk(robot, "random")) == "order 'random': must be depth-first or breadth-first"
    deep, broad = (export.motion_clip(short(), ROBOT, order=o) for o in ("depth-first", "breadth-first"))
    assert list(deep["body_names"]) == list(export.motion_clip(short(), ROBOT)["body_names"])
    for names, array in (("joint_names", "joint_vel"), ("body_names", "body_quat_w")):
        order = [list(deep[names]).index(n) for n in broad[names]]
        assert order != sorted(order)
        np.testing.assert_array_equal(deep[array][:, order], broad[array])
    assert len(deep["joint_pos"]) == 2 and list(deep["fps"]) == [50]  # 0 and 20 ms
    assert refused(lambda: export.motion_clip(short(), ROBOT, fps=12.5)) == (
        "fps = 12.5: clips carry whole frames per second"
    )


# files ----------------------------------------------------------------------------------------------------------
NAMES = {"csv": "joints.csv", "npz": "motion.npz", "motion-clip": "motion_clip.npz", "urdf-replay": "replay"}


def test_files_and_their_names(tmp_path):
    assert {k: export.default_name(k, "plan") for k in export.FORMATS} == NAMES
    assert {k: export.default_name(k, "simulation") for k in NAMES} == {k: f"simulated_{x}" for k, x in NAMES.items()}
    assert refused(lambda: export.write("bvh", short(), ROBOT, tmp_path / "x")) == (
        "format 'bvh': must be one of csv, npz, motion-clip, urdf-replay"
    )
    for name, ending in (("csv", ".csv"), ("npz", ".npz"), ("motion-clip", ".npz")):
        assert refused(lambda name=name: export.write(name, short(), ROBOT, tmp_path / "x.txt")) == (
            f"--out must name a file that ends in {ending}, got {str(tmp_path / 'x.txt')!r}"
        )
    path = export.write("csv", short(), ROBOT, str(tmp_path / "LOUD.CSV"))
    assert path == tmp_path / "LOUD.CSV" and path.read_text() == export.joint_table(short(), ROBOT)
    for name, arrays, options in (
        ("npz", export.plain_arrays(short(), ROBOT), {}),
        ("motion-clip", export.motion_clip(short(), ROBOT), {}),
        ("motion-clip", export.motion_clip(short(), ROBOT, fps=250, order="breadth-first"),
         {"fps": 250, "order": "breadth-first"}),
    ):  # fmt: skip
        path = export.write(name, short(), ROBOT, tmp_path / "x.npz", **options)
        raw = sum(x.nbytes for x in arrays.values())
        with np.load(path, allow_pickle=False) as file:
            assert file.files == list(arrays)
            for key, x in arrays.items():
                np.testing.assert_array_equal(file[key], x)
        assert path.stat().st_size < raw + 300 * len(arrays)  # compressed


def test_the_folder_of_a_replay(tmp_path):
    folder = tmp_path / "replay"
    assert export.write("urdf-replay", replace(short(), source="simulation"), ROBOT, folder) == folder
    assert sorted(p.name for p in folder.iterdir()) == ["README.md", "replay.py", "robot.urdf", "trajectory.npz"]
    assert (folder / "robot.urdf").read_text() == ROBOT.urdf
    readme, script = (folder / "README.md").read_text(), (folder / "replay.py").read_text()
    assert re.search(r"```python\n(.*?)\n```", readme, re.S)[1] == script.strip()
    assert "@@" not in readme and "simulation" in readme and ROBOT.name in readme
    arrays = export.plain_arrays(replace(short(), source="simulation"), ROBOT, 100.0)
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
    assert refused(lambda: export.write("urdf-replay", short(), ROBOT, folder)) == (
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
    assert len(motion.at([]).t) == 0
    assert motion.at([0.5205 + 0.9e-9]).tau[0] == pytest.approx(motion.tau[-1])
    for outside in ([0.4999, 0.51], [0.51, 0.5205 + 2e-9]):
        first, last = (f"{x:g}" for x in outside)
        assert refused(lambda times=outside: motion.at(times)) == (
            f"times {first} ... {last} s leave the motion, 0.5 ... 0.5205 s"
        )


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
    assert list(motion.every(0.5).t) == [0.5]
    rounded = replace(motion, t=np.append(motion.t[:-1], 0.5205 - 1e-10))
    assert rounded.every(2000.0).t[-1] == rounded.t[-1]
    for rate in (0.0, -1.0, 10_000.1):
        assert refused(lambda rate=rate: motion.every(rate)) == (
            f"rate = {rate:g} per second must lie above 0 and not above 10000"
        )


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
    record.a = short().v
    assert Motion.of(record).source == "plan"
    assert refused(lambda: Motion.of_simulation_file(tmp_path, ROBOT)) == (
        f"{str(tmp_path)!r} holds no simulation; run 'jumplab simulate {tmp_path}' first"
    )
    good = {k: getattr(short(), k) for k in ("t", "q", "v", "tau", "phase")}
    good |= {"schema": np.array("jumplab-simulation-1"), "joint_names": np.array(JOINTS), "more": np.arange(3)}
    path = tmp_path / "simulation.npz"
    np.savez(path, **good)
    back = Motion.of_simulation_file(tmp_path, ROBOT)
    assert back.source == "simulation"
    for name in ("t", "q", "v", "tau", "phase"):
        np.testing.assert_array_equal(getattr(back, name), good[name])
    assert list(read_simulation(str(tmp_path), ROBOT, ("more", "t", "q", "v", "tau", "phase"))["more"]) == [0, 1, 2]
    foreign = f"{path}: not a simulation of this folder's robot; simulate the plan again"
    wrong = {"q": good["q"][:, 1:], "v": good["v"][1:], "tau": good["tau"][:, 1:], "phase": good["phase"][1:],
             "schema": np.array("x"), "joint_names": good["joint_names"][::-1], "t": good["t"][None]}  # fmt: skip
    for name, value in wrong.items():
        np.savez(path, **(good | {name: value}))
        assert refused(lambda: Motion.of_simulation_file(tmp_path, ROBOT)) == foreign
    np.savez(path, **{k: x for k, x in good.items() if k != "tau"})
    assert refused(lambda: Motion.of_simulation_file(tmp_path, ROBOT)) == (
        f"{path}: not a readable simulation (KeyError); simulate the plan again"
    )
    np.savez(path, **(good | {"t": good["t"].astype(object)}))
    assert "not a readable simulation (ValueError)" in refused(lambda: Motion.of_simulation_file(tmp_path, ROBOT))
    with pytest.raises(AttributeError):
        back.source = "plan"
