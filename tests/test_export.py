"""Exports, each read back as its reader would and compared with Pinocchio, MuJoCo or PyBullet."""

import re
import sys
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump
from test_cli import one_sentence, run
from test_robot import with_free_base
from test_store import names

from jumplab.errors import InputError
from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.motion import Motion


@pytest.fixture(scope="module")
def motion():
    return Motion.of(jump(1.0, 0.5).tape)


@pytest.fixture(scope="module")
def flip():
    """The plan's joints on a base that rolls and yaws as well, so that no axis is at rest."""
    tape, robot = jump(1.0, 0.5).tape, jump(1.0, 0.5).robot
    model, tilt = robot.model, pin.SE3(pin.rpy.rpyToMatrix(0.4, 0.0, -1.1), np.array([0.2, -0.3, 0.1]))
    q = tape.q.copy()
    for k, row in enumerate(tape.q):
        q[k, :7] = pin.SE3ToXYZQUAT(tilt * pin.XYZQUATToSE3(row[:7]))
    assert model.nq == q.shape[1]
    return Motion(tape.t, q, tape.v, tape.tau, tape.phase, "plan")  # base twists are in the base frame: unchanged


# joint table ----------------------------------------------------------------------------------------------------
def test_joint_table(motion, bhr, odd_folder):
    tape = jump(1.0, 0.5).tape
    path = export.write("csv", motion, bhr, odd_folder / "joints.csv")
    head = path.read_text().splitlines()[0].split(",")
    table = np.genfromtxt(path, delimiter=",", names=True)
    assert list(table.dtype.names) == head and len(head) == 2 + 3 * len(bhr.joint_names)
    assert np.diff(table["time_s"]) == pytest.approx(0.001, abs=1e-9)
    assert table["time_s"][0] == 0 and table["time_s"][-1] == np.floor(tape.t[-1] * 1000) / 1000
    rows = np.concatenate([np.arange(tape.takeoff_index - 1), np.arange(tape.takeoff_index, len(tape.t) - 1)])
    assert len(rows) == len(table)  # take-off once, and the fraction of a millisecond at the end not at all
    model = bhr.model
    for name in bhr.joint_names:
        i, j = model.idx_qs[model.getJointId(name)], model.idx_vs[model.getJointId(name)]
        assert table[f"{name}_position_rad"] == pytest.approx(tape.q[rows, i], abs=1e-7)
        assert table[f"{name}_velocity_rad_s"] == pytest.approx(tape.v[rows, j], abs=1e-6)
        assert table[f"{name}_torque_N_m"] == pytest.approx(tape.tau[rows, j - 6], abs=1e-5)
    code = table["phase_0_launch_1_flight_2_landing"]
    assert table["time_s"][code == 1][0] == pytest.approx(np.ceil(tape.takeoff_time * 1000) / 1000, abs=1e-9)


# plain arrays ---------------------------------------------------------------------------------------------------
def test_plain_arrays(flip, bhr, tmp_path):
    with np.load(export.write("npz", flip, bhr, tmp_path / "motion.npz"), allow_pickle=False) as file:
        x = {k: file[k] for k in file.files}
    model, data = bhr.model, bhr.model.createData()
    assert tuple(x["joint_names"]) == bhr.joint_names and np.diff(x["time_s"]) == pytest.approx(0.001)
    for k in range(0, len(x["time_s"]), 97):
        row = np.searchsorted(flip.t, x["time_s"][k] + 1e-9) - 1
        pin.forwardKinematics(model, data, flip.q[row], flip.v[row])
        twist = pin.getVelocity(model, data, 1, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        assert x["base_position_m"][k] == pytest.approx(data.oMi[1].translation, abs=1e-6)
        turn = pin.Quaternion(x["base_quaternion_xyzw"][k]).toRotationMatrix()
        assert turn == pytest.approx(data.oMi[1].rotation, abs=1e-6)
        assert x["base_velocity_world_m_s"][k] == pytest.approx(twist.linear, abs=1e-5)
        assert x["base_angular_velocity_world_rad_s"][k] == pytest.approx(twist.angular, abs=1e-5)
        assert x["joint_position_rad"][k] == pytest.approx(flip.q[row, 7:], abs=1e-6)
        assert x["joint_torque_N_m"][k] == pytest.approx(flip.tau[row], abs=1e-4)


# motion clip ----------------------------------------------------------------------------------------------------
def read_clip(motion, robot, folder, **options):
    path = export.write("motion-clip", motion, robot, folder / "clip.npz", **options)
    with np.load(path, allow_pickle=False) as file:
        return {k: file[k] for k in file.files}


def test_clip_has_the_layout_that_trackers_index(flip, bhr, tmp_path):
    clip = read_clip(flip, bhr, tmp_path)
    frames, joints, bodies = int(np.floor(flip.duration * 50)) + 1, len(bhr.joint_names), len(clip["body_names"])
    shapes = {"fps": (1,), "joint_pos": (frames, joints), "joint_vel": (frames, joints), "joint_names": (joints,),
              "body_pos_w": (frames, bodies, 3), "body_quat_w": (frames, bodies, 4), "body_names": (bodies,),
              "body_lin_vel_w": (frames, bodies, 3), "body_ang_vel_w": (frames, bodies, 3)}  # fmt: skip
    assert {k: x.shape for k, x in clip.items()} == shapes
    assert clip["fps"][0] == 50 and clip["body_names"][0] == "trunk"
    assert all(x.dtype == np.float32 for k, x in clip.items() if k[-1] != "s")


def test_clip_in_mujoco(flip, bhr, tmp_path):
    """MuJoCo is told base and joints of each frame and must find every body where the clip has it, by number."""
    clip = read_clip(flip, bhr, tmp_path)
    model = mujoco.MjModel.from_xml_string(with_free_base(bhr.urdf))
    data = mujoco.MjData(model)
    assert [model.body(i).name for i in range(1, model.nbody)] == list(clip["body_names"])
    assert [model.joint(i).name for i in range(1, model.njnt)] == list(clip["joint_names"])
    velocity = np.zeros(6)
    for k in range(len(clip["joint_pos"])):
        turn = clip["body_quat_w"][k, 0]
        rotation = pin.Quaternion(*turn.astype(float)).normalized().toRotationMatrix()
        data.qpos[:] = np.concatenate([clip["body_pos_w"][k, 0], turn, clip["joint_pos"][k]])
        spin = rotation.T @ clip["body_ang_vel_w"][k, 0]
        data.qvel[:] = np.concatenate([clip["body_lin_vel_w"][k, 0], spin, clip["joint_vel"][k]])
        mujoco.mj_forward(model, data)
        assert clip["body_pos_w"][k] == pytest.approx(data.xpos[1:], abs=2e-6)
        same = np.abs(np.sum(clip["body_quat_w"][k] * data.xquat[1:], axis=1))
        assert same == pytest.approx(1.0, abs=1e-6)
        for i in range(1, model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, i, velocity, 0)
            assert clip["body_ang_vel_w"][k, i - 1] == pytest.approx(velocity[:3], abs=2e-5)
            assert clip["body_lin_vel_w"][k, i - 1] == pytest.approx(velocity[3:], abs=2e-5)


def test_clip_against_pinocchio_at_an_odd_rate(flip, bhr, tmp_path):
    """Interpolated frames: poses of a Pinocchio state, velocities their derivative by finite differences."""
    clip = read_clip(flip, bhr, tmp_path, fps=240)
    model, data = bhr.model, bhr.model.createData()
    ids = [model.getFrameId(str(n)) for n in clip["body_names"]]
    for k in range(0, len(clip["joint_pos"]), 31):
        row = min(np.searchsorted(flip.t, k / 240, side="right") - 1, len(flip.t) - 2)
        share = (k / 240 - flip.t[row]) / (flip.t[row + 1] - flip.t[row])
        pin.framesForwardKinematics(model, data, pin.interpolate(model, flip.q[row], flip.q[row + 1], share))
        for i, frame in enumerate(ids):
            assert clip["body_pos_w"][k, i] == pytest.approx(data.oMf[frame].translation, abs=1e-5)
    middle = (clip["body_pos_w"][2:].astype(float) - clip["body_pos_w"][:-2]) * 120
    assert np.abs(middle - clip["body_lin_vel_w"][1:-1]).max() < 0.05
    steps = np.sum(clip["body_quat_w"][1:] * clip["body_quat_w"][:-1], axis=2)
    assert steps.min() > 0.99  # neither leaps nor changes of sign


def test_clip_orders(flip, bhr, tmp_path):
    deep, broad = (read_clip(flip, bhr, tmp_path, order=o) for o in export.ORDERS)
    assert list(broad["body_names"][:7]) == [
        "trunk", "left_hip_yaw_link", "right_hip_yaw_link", "left_arm", "right_arm", "left_hip_roll_link",
        "right_hip_roll_link"]  # fmt: skip
    assert broad["joint_names"][0] == "left_hip_yaw" and broad["joint_names"][-1] == "right_ankle_roll"
    for names_of, arrays in {"body_names": ("body_pos_w", "body_quat_w"), "joint_names": ("joint_pos",)}.items():
        order = [list(deep[names_of]).index(n) for n in broad[names_of]]
        assert sorted(order) == list(range(len(order))) and order != sorted(order)
        for name in arrays:
            assert np.array_equal(deep[name][:, order], broad[name])


# replay ---------------------------------------------------------------------------------------------------------
def test_replay_by_the_script_of_its_readme(flip, bhr, odd_folder, monkeypatch):
    pybullet = pytest.importorskip("pybullet")
    folder = export.write("urdf-replay", flip, bhr, odd_folder / "replay")
    assert names(folder) == ["README.md", "replay.py", "robot.urdf", "trajectory.npz"]
    script = re.search(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.S)[1]
    assert script == (folder / "replay.py").read_text() and len(script.splitlines()) <= 10
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["replay.py", "--no-window"])
    space = {}
    try:
        exec(script, space)
        last = Motion.of(flip).every(100.0).q[-1]
        model, data = bhr.model, bhr.model.createData()
        pin.framesForwardKinematics(model, data, last)
        for i in range(pybullet.getNumJoints(space["robot"])):
            link = pybullet.getJointInfo(space["robot"], i)[12].decode()
            place, turn = pybullet.getLinkState(space["robot"], i, computeForwardKinematics=True)[4:6]
            frame = data.oMf[model.getFrameId(link)]
            assert place == pytest.approx(frame.translation, abs=1e-5), link
            assert pin.Quaternion(np.array(turn)).toRotationMatrix() == pytest.approx(frame.rotation, abs=1e-5)
    finally:
        pybullet.disconnect()


# refusals -------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """A plan on file, with a simulation that stands still."""
    folder, p = tmp_path_factory.mktemp("plan"), jump(1.0, 0.5)
    store.write_plan(folder, p.tape, p.robot, p.summary)
    n, nv = 30, p.robot.model.nv
    np.savez(folder / "simulation.npz", schema=np.array("jumplab-simulation-1"), t=np.arange(n) / 1000,
             q=np.repeat(p.tape.q[:1], n, axis=0), v=np.zeros((n, nv)), tau=np.ones((n, nv - 6)),
             phase=np.array(["landing"] * n), joint_names=np.array(p.robot.joint_names))  # fmt: skip
    return folder


def test_command(capsys, plan, tmp_path):
    duration = store.read_plan(plan)[0].t[-1]
    for format_name, name in export.FORMATS.items():
        out = tmp_path / "new" / name
        code, said, err = run(capsys, "export", plan, "--format", format_name, "--out", out)
        assert (code, err) == (0, "") and said == f"plan, {duration:.3f} s, as {format_name}: {out}\n" and out.exists()
    code, said, err = run(capsys, "export", plan, "--format", "csv", "--simulated")
    assert (code, err) == (0, "") and said.startswith("simulation, 0.029 s, as csv: ")
    table = np.genfromtxt(plan / "simulated_joints.csv", delimiter=",", names=True)
    assert len(table) == 30 and set(table["phase_0_launch_1_flight_2_landing"]) == {2}
    (plan / "simulated_joints.csv").unlink()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--format", "csv", "--out", "x.txt"], "--out must name a file that ends in .csv, got 'x.txt'"),
        (["--format", "motion-clip", "--fps", "many"], "--fps must be a number, got 'many'"),
        (["--format", "motion-clip", "--fps", "12.5", "--out", "x.npz"],
         "fps = 12.5: clips carry whole frames per second"),
        (["--format", "motion-clip", "--fps", "0", "--out", "x.npz"],
         "rate = 0 per second must lie above 0 and not above 10000"),
        (["--format", "npz", "--out", "/dev/null/x.npz"],
         "'/dev/null' is a file; choose a folder"),
        (["--format", "urdf-replay", "--out", "mine"],
         "the folder 'mine' already holds 'thesis.tex'; choose a new or an empty one"),
        (["--format", "urdf-replay", "--out", "mine/thesis.tex"], "'mine/thesis.tex' is a file; choose a folder"),
        (["--format", "csv", "--out", ""], "--out must name a folder, got ''"),
    ],
)  # fmt: skip
def test_refusals(capsys, plan, tmp_path, monkeypatch, arguments, sentence):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    monkeypatch.chdir(tmp_path)
    before = names(plan)
    assert one_sentence(*run(capsys, "export", plan, *arguments)) == sentence
    assert names(tmp_path) == ["mine"] and names(tmp_path / "mine") == ["thesis.tex"] and names(plan) == before


def test_unknown_format_and_order(motion, bhr, tmp_path):
    with pytest.raises(InputError, match=r"^format 'bvh': must be one of csv, npz, motion-clip, urdf-replay$"):
        export.write("bvh", motion, bhr, tmp_path / "x")
    with pytest.raises(InputError, match=r"^order 'random': must be depth-first or breadth-first$"):
        export.motion_clip(motion, bhr, order="random")


def test_a_failing_write_leaves_the_older_file(motion, bhr, tmp_path, monkeypatch):
    path = tmp_path / "a" / "joints.csv"
    path.parent.mkdir()
    path.write_text("older")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(InputError, match="No space left on device"):
        export.write("csv", motion, bhr, path)
    with pytest.raises(InputError, match="No space left on device"):
        export.write("csv", motion, bhr, tmp_path / "new" / "joints.csv")
    assert path.read_text() == "older" and names(path.parent) == ["joints.csv"] and names(tmp_path) == ["a"]


def test_a_new_plan_removes_exports_of_the_old_one(bhr, tmp_path):
    p = jump(1.0, 0.5)
    store.write_plan(tmp_path, p.tape, p.robot, p.summary)
    export.write("csv", Motion.of(p.tape), bhr, tmp_path / "joints.csv")
    export.write("urdf-replay", Motion.of(p.tape), bhr, tmp_path / "replay")
    Path(tmp_path / "jump.html").write_text("old")
    store.write_plan(tmp_path, p.tape, p.robot, p.summary)
    assert names(tmp_path) == ["plan.npz", "robot.toml", "robot.urdf", "summary.json"]
