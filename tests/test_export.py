"""Exports, each read back as its reader would and compared with Pinocchio, MuJoCo or PyBullet."""

import pickle
import re
import sys
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump
from fixtures_robots import arm_base, held_arms, needs_published, sideways, waist, write
from scipy.spatial.transform import Rotation
from test_cli import one_sentence, run
from test_store import names

from jumplab.errors import InputError, RobotError
from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.motion import Motion, steady
from jumplab.io.tensors import read_tensors
from jumplab.io.whole import ORDERS, Whole, ordered
from jumplab.robot import Robot
from jumplab.robot.files import SHIPPED
from jumplab.robot_import.urdf import PACKAGE, locate


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


# every frame of every format in MuJoCo --------------------------------------------------------------------------
G1 = pytest.param("g1", marks=needs_published)


def published(name: str) -> str:
    """The URDF that a robot comes from, without its meshes."""
    if name == "bhr":
        return Robot.load().urdf
    root = ET.parse(locate(f"{PACKAGE}:g1_description/urdf/g1_29dof_rev_1_0.urdf", SHIPPED["bhr"].parent)).getroot()
    for link in root.iterfind("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    return ET.tostring(root, encoding="unicode")


def tumbling(robot, end=0.2105) -> Motion:
    """A motion in which nothing is at rest, with contacts that change."""
    rng, t = np.random.default_rng(8), np.append(np.arange(0.0, end, 0.001), end)
    model, rate = robot.model, rng.normal(0, 2, robot.model.nv)
    q = np.array([pin.integrate(model, pin.neutral(model), rate * x) for x in t])
    v = rate + rng.normal(0, 1, (len(t), model.nv))
    phase = np.where(t < 0.1, "launch", np.where(t < 0.2, "flight", "landing"))
    contact = rng.uniform(size=(len(t), 2)) < 0.5
    return Motion(t, q, v, rng.normal(0, 9, (len(t), model.nv - 6)), phase, "simulation", contact=contact)


def npz(path) -> dict:
    with np.load(path, allow_pickle=False) as file:
        return {k: file[k] for k in file.files}


def states(format_name: str, path) -> dict:
    """Content of a format, under MuJoCo's names where it has them: qpos (F, 7 + J), qvel, and all of its own."""
    if format_name == "unitree-csv":
        rows = np.loadtxt(path, delimiter=",")
        return {"qpos": rows[:, [0, 1, 2, 6, 3, 4, 5, *range(7, rows.shape[1])]]}
    if format_name == "gmr-pkl":
        x = pickle.loads(path.read_bytes())
        return x | {"qpos": np.column_stack([x["root_pos"], x["root_rot"][:, [3, 0, 1, 2]], x["dof_pos"]])}
    if format_name == "csv":
        x = np.genfromtxt(path, delimiter=",", names=True)
        names = [n.removesuffix("_position_rad") for n in x.dtype.names if n.endswith("_position_rad")]
        return {"joint_names": names} | {
            own: np.column_stack([x[f"{name}_{kind}"] for name in names])
            for own, kind in (("angles", "position_rad"), ("rates", "velocity_rad_s"), ("torque", "torque_N_m"))
        } | {"contact": np.column_stack([x["contact_left"], x["contact_right"]])}  # fmt: skip
    if format_name in ("asap-pkl", "sonic-pkl"):  # as their loaders do: the root and the joints from rotation vectors
        (entry,) = pickle.loads(path.read_bytes()).values()
        aa, count = entry["pose_aa"].astype(float), len(entry["joint_names"])
        turn = np.roll(Rotation.from_rotvec(aa[:, 0]).as_quat(), 1, axis=1)
        turn *= np.sign(np.sum(turn * np.roll(entry["root_rot"], 1, axis=1), axis=1, keepdims=True))
        angles = aa[:, 1 : 1 + count].sum(axis=2)  # axes are those of the frame
        qpos = np.column_stack([entry["root_trans_offset"], turn, angles])
        assert np.abs(angles - entry["dof"]).max() < 1e-6 and not aa[:, 1 + count :].any()
        assert aa.shape[1] == 1 + count + 3 * (format_name == "asap-pkl") and len(entry["smpl_joints"]) == len(aa)
        whole = not any("wrist" in name for name in entry["joint_names"]) and format_name == "asap-pkl"
        return {} if whole and count == 23 else {"qpos": qpos, "joint_names": entry["joint_names"]}
    if format_name == "bones-csv":
        x = np.genfromtxt(path, delimiter=",", names=True)
        place, turn = (np.column_stack([x[f"root_{w}{a}"] for a in "XYZ"]) for w in ("translate", "rotate"))
        quaternions = steady(np.roll(Rotation.from_euler("xyz", turn, degrees=True).as_quat(), 1, axis=1))
        names = [n for n in x.dtype.names if n.endswith("_dof")]
        angles = np.radians(np.column_stack([x[n] for n in names]))
        assert x.dtype.names[0] == "Frame" and (np.diff(x["Frame"]) == 1).all()
        return {"qpos": np.column_stack([place / 100, quaternions, angles]),
                "joint_names": [n.removesuffix("_dof") for n in names]}  # fmt: skip
    if format_name == "protomotions":
        x = read_tensors(path.read_bytes())
        first_w = np.roll(x["rigid_body_rot"], 1, axis=-1)
        return {"qpos": np.column_stack([x["rigid_body_pos"][:, 0], first_w[:, 0], x["dof_pos"]]),
                "body_pos_w": x["rigid_body_pos"], "body_quat_w": first_w, "body_lin_vel_w": x["rigid_body_vel"],
                "body_ang_vel_w": x["rigid_body_ang_vel"], "rates": x["dof_vel"]}  # fmt: skip
    folder = {"mujoco": "motion.npz", "urdf-replay": "trajectory.npz"}.get(format_name)
    x = npz(path / folder if folder else path)
    if format_name in ("npz", "urdf-replay"):
        turn = x["base_quaternion_xyzw"][:, [3, 0, 1, 2]]
        spin = np.array([pin.Quaternion(*a).toRotationMatrix().T @ w for a, w in
                         zip(turn, x["base_angular_velocity_world_rad_s"], strict=True)])  # fmt: skip
        x["qpos"] = np.column_stack([x["base_position_m"], turn, x["joint_position_rad"]])
        x["qvel"] = np.column_stack([x["base_velocity_world_m_s"], spin, x["joint_velocity_rad_s"]])
    if format_name == "isaaclab-npz":
        x["order"] = x.pop("joint_names")
    if format_name == "holosoma-npz":
        x |= {"qpos": x["joint_pos"], "qvel": x["joint_vel"]}
    return x


@pytest.mark.parametrize("name", ["bhr", G1])
def test_every_frame_of_every_format_in_mujoco(name, tmp_path):
    """MuJoCo has the URDF as its maker published it; where the root and the joints are, is the motion's word."""
    robot, spec = Robot.load(name), mujoco.MjSpec.from_string(published(name))
    spec.compiler.fusestatic = True
    spec.worldbody.first_body().add_freejoint()
    model = spec.compile()
    data, motion = mujoco.MjData(model), tumbling(robot)
    joints = [model.joint(i).name for i in range(1, model.njnt)]
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    assert (len(joints), len(bodies)) == {"bhr": (14, 15), "g1": (29, 30)}[name]
    held = {"left_elbow_joint": 0.9, "right_elbow_joint": 0.9}
    for format_name, (file, rate) in export.FORMATS.items():
        x = states(format_name, export.write(format_name, motion, robot, tmp_path / file))
        frames = motion.every(rate, end=True)
        at = {n: robot.joint_names.index(n) for n in robot.joint_names}
        angles = np.column_stack([frames.q[:, 7 + at[n]] if n in at else np.full(len(frames.t), held.get(n, 0.0))
                                  for n in joints])  # fmt: skip
        rates = np.column_stack([frames.v[:, 6 + at[n]] if n in at else 0 * frames.t for n in joints])
        turn = [pin.Quaternion(q[3:7]).toRotationMatrix() for q in frames.q]
        velocity = np.einsum("fij,fj->fi", turn, frames.v[:, :3])
        qpos = np.column_stack([frames.q[:, :3], frames.q[:, [6, 3, 4, 5]], angles])
        qvel = np.column_stack([velocity, frames.v[:, 3:6], rates])
        check_states(format_name, x, joints, qpos, qvel)
        if "contact" in x:
            assert (np.asarray(x["contact"], bool) == frames.contact).all()
        for k in range(len(qpos)) if "body_pos_w" in x or "local_body_pos" in x else ():
            data.qpos[:], data.qvel[:] = qpos[k], qvel[k]
            mujoco.mj_forward(model, data)
            check_bodies(format_name, x, k, model, data, bodies)


def check_states(format_name, x, joints, qpos, qvel):
    if "qpos" in x:
        assert np.abs(x["qpos"][:, [0, 1, 2]] - qpos[:, :3]).max() < 1e-5, format_name
        assert np.abs(np.sum(x["qpos"][:, 3:7] * qpos[:, 3:7], axis=1)) == pytest.approx(1.0, abs=1e-6)
        assert np.abs(x["qpos"][:, 7:] - qpos[:, 7:]).max() < 1e-5
        assert (np.sum(x["qpos"][1:, 3:7] * x["qpos"][:-1, 3:7], axis=1) > 0).all()
    if "qvel" in x:
        assert np.abs(x["qvel"] - qvel).max() < 1e-5
    if "joint_names" in x and format_name != "beyondmimic-npz":
        assert list(x["joint_names"]) == joints
    if format_name == "csv":
        assert np.abs(x["angles"] - qpos[:, 7:]).max() < 1e-5 and np.abs(x["rates"] - qvel[:, 6:]).max() < 1e-5
    if format_name == "isaaclab-npz":
        assert (
            np.abs(x["base_pos_w"] - qpos[:, :3]).max() < 1e-5
            and np.abs(x["base_lin_vel_w"] - qvel[:, :3]).max() < 1e-5
        )
        assert np.abs(np.sum(x["base_quat_w"] * qpos[:, 3:7], axis=1)) == pytest.approx(1.0, abs=1e-6)
        spin = Rotation.from_quat(np.roll(qpos[:, 3:7], -1, axis=1)).apply(qvel[:, 3:6])
        assert np.abs(x["base_ang_vel_w"] - spin).max() < 1e-5 and x["framerate"] == x["fps"]
        columns = [joints.index(name) for name in x["order"]]
        assert np.abs(x["joint_pos"] - qpos[:, 7:][:, columns]).max() < 1e-5
        assert np.abs(x["joint_vel"] - qvel[:, 6:][:, columns]).max() < 1e-5
    if format_name == "protomotions":
        assert np.abs(x["rates"] - qvel[:, 6:]).max() < 1e-5
    if format_name in ("mjlab-npz", "beyondmimic-npz", "unilab-npz"):
        columns = [joints.index(name) for name in x["joint_names"]]
        assert np.abs(x["joint_pos"] - qpos[:, 7:][:, columns]).max() < 1e-5
        assert np.abs(x["joint_vel"] - qvel[:, 6:][:, columns]).max() < 1e-5


def check_bodies(format_name, x, k, model, data, bodies):
    twist = np.zeros(6)
    if format_name == "gmr-pkl":
        assert x["link_body_list"] == bodies
        local = (data.xpos[1:] - data.xpos[1]) @ data.xmat[1].reshape(3, 3)
        assert np.abs(x["local_body_pos"][k] - local).max() < 1e-5
        return
    first = int(format_name in ("holosoma-npz", "unilab-npz"))
    names = list(x.get("body_names", bodies))
    assert names == ["world", *bodies][1 - first :] or format_name == "beyondmimic-npz"
    assert sorted(names[first:]) == sorted(bodies)
    at_com = format_name in ("beyondmimic-npz", "holosoma-npz")
    of = mujoco.mjtObj.mjOBJ_BODY if at_com else mujoco.mjtObj.mjOBJ_XBODY  # centre of mass, or origin
    for i, name in enumerate(names):
        body = model.body(name).id
        mujoco.mj_objectVelocity(model, data, of, body, twist, 0)
        assert np.abs(x["body_pos_w"][k, i] - data.xpos[body]).max() < 1e-5
        assert abs(x["body_quat_w"][k, i] @ data.xquat[body]) == pytest.approx(1.0, abs=1e-6)
        assert np.abs(x["body_ang_vel_w"][k, i] - twist[:3]).max() < 2e-5
        assert np.abs(x["body_lin_vel_w"][k, i] - twist[3:]).max() < 2e-5


@pytest.mark.parametrize("name", ["bhr", G1])
def test_the_folder_for_mujoco(name, tmp_path):
    """Its XML is the published robot: bodies, masses, places and motors, in the order of the trajectory."""
    folder = export.write("mujoco", tumbling(Robot.load(name)), Robot.load(name), tmp_path / "mujoco")
    model, x = mujoco.MjModel.from_xml_path(str(folder / "robot.xml")), npz(folder / "motion.npz")
    spec = mujoco.MjSpec.from_string(published(name))
    spec.compiler.fusestatic = True
    spec.worldbody.first_body().add_freejoint()
    there = spec.compile()
    assert (model.nq, model.nv, model.nu) == (there.nq, there.nv, there.nv - 6) and model.nbody == there.nbody
    assert x["qpos"].shape[1:] == (model.nq,) and x["qvel"].shape[1:] == (model.nv,) and x["fps"] == 1000
    assert [model.actuator(i).name for i in range(model.nu)] == list(x["joint_names"])
    assert [model.joint(i).name for i in range(1, model.njnt)] == list(x["joint_names"])
    effort = [Robot.load(name).actuators.get(joint, {}).get("effort") for joint in x["joint_names"]]
    for limits, most in zip(model.actuator_ctrlrange, effort, strict=True):
        assert (limits == [-most, most]).all() if most else limits[1] > 0  # as it was planned with
    assert model.opt.timestep == mujoco.MjOption().timestep == 0.002  # what users have, contacts too
    assert model.opt.cone == mujoco.MjOption().cone and (model.geom_solref == [0.02, 1.0]).all()
    for mine, other in ((model.body_mass, there.body_mass), (model.body_inertia, there.body_inertia),
                        (model.body_ipos, there.body_ipos), (model.body_pos, there.body_pos)):  # fmt: skip
        assert np.abs(mine - other)[1:].max() < 1e-6
    data, other = mujoco.MjData(model), mujoco.MjData(there)
    data.ctrl[:] = x["ctrl"][3]
    for each, has in ((data, model), (other, there)):
        each.qpos[:], each.qvel[:] = x["qpos"][3], x["qvel"][3]
        mujoco.mj_forward(has, each)
    assert data.qfrc_actuator[6:] == pytest.approx(np.clip(x["ctrl"][3], *model.jnt_actfrcrange[1:].T))  # the effort
    assert np.abs(data.xpos - other.xpos).max() < 1e-6 and model.opt.gravity[2] == -9.8


@needs_published
def test_orders_of_a_g1():
    """As trackers count them: the left leg first, or level by level."""
    whole = Whole(Robot.load("g1"))
    legs = [f"{side}_{joint}_joint" for side in ("left", "right") for joint in
            ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")]  # fmt: skip
    arms = [f"{side}_{joint}_joint" for side in ("left", "right") for joint in
            ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch",
             "wrist_yaw")]  # fmt: skip
    assert list(whole.joints) == [*legs, "waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint", *arms]
    assert [name.removesuffix("_joint") for name in ordered(whole.urdf, ORDERS[1])[0]][:9] == [
        "left_hip_pitch", "right_hip_pitch", "waist_yaw", "left_hip_roll", "right_hip_roll", "waist_roll",
        "left_hip_yaw", "right_hip_yaw", "waist_pitch"]  # fmt: skip
    assert whole.links[0] == "pelvis" and len(whole.links) == 30


# the published robot and the one that jumps ---------------------------------------------------------------------
@pytest.mark.parametrize("variant", [sideways, arm_base, waist, held_arms], ids=lambda v: v.__name__)
def test_both_robots_are_one(variant, tmp_path):
    """Wherever the root is: same mass, centre of mass and momenta as the robot that jumps."""
    robot = Robot.load(write(tmp_path, variant))
    whole, motion = Whole(robot), tumbling(robot, 0.02)
    x, here, there = whole.frames(motion, 1000.0), robot.model, whole.model
    a, b = here.createData(), there.createData()
    for *jumping, q, v in zip(motion.q, motion.v, *whole.states(x), strict=True):
        pin.ccrba(here, a, *jumping)
        pin.ccrba(there, b, q, v)
        assert b.com[0] == pytest.approx(a.com[0], abs=1e-9)
        assert b.hg.vector == pytest.approx(a.hg.vector, abs=1e-8)
    assert set(robot.joint_names) <= set(whole.joints)


def test_held_joints_carry_what_hangs_on_them(tmp_path):
    """A robot that stands still: its held arms pull at their shoulders by their weight times their lever."""
    robot = Robot.load(write(tmp_path, held_arms))
    whole, motion = Whole(robot), tumbling(robot, 0.02)
    lean = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.0)).coeffs()  # face down, so that arms lie level
    still = Motion(motion.t, np.tile([*motion.q[0, :3], *lean, *motion.q[0, 7:]], (len(motion.t), 1)), 0 * motion.v,
                   motion.tau, motion.phase, "plan")  # fmt: skip
    x = whole.frames(still, 100.0)
    held = [i for i, name in enumerate(whole.joints) if name not in robot.joint_names]
    assert held
    for i in held:
        joint = whole.model.getJointId(whole.joints[i])
        inertia, rate = whole.model.inertias[joint], np.abs(x.tau[:, i])
        assert rate == pytest.approx(inertia.mass * robot.gravity * abs(inertia.lever[2]), rel=1e-6)


def test_a_robot_that_was_changed_is_not_the_published_one(tmp_path):
    robot = Robot.load(write(tmp_path, held_arms))
    name = robot.joints["knee"][0]
    at = robot.urdf.index(f'<joint name="{name}"')
    place = re.search(r'xyz="([^"]*)"', robot.urdf[at:])
    x, y, z = map(float, place[1].split())
    longer = robot.urdf[:at] + robot.urdf[at:].replace(place[0], f'xyz="{x} {y} {z - 0.05}"', 1)
    other = Robot.from_text(longer, robot.config_text)
    with pytest.raises(InputError, match=(
        rf"^robot {robot.name}: joint '.*' lies 50 mm from its place in the published robot, at most 10; "
        r"import the changed robot's own URDF$"
    )):  # fmt: skip
        Whole(other).frames(tumbling(other, 0.01), 50.0)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("urdf = '''", "urdf = '''<", r"\[published\] holds no URDF: "),
        ('trunk = "', 'trunk = "no_', r"\[published\] lacks the link 'no_.*'$"),
        ("[published.held]", "[published.held]\nelbow = 1.0", r"\[published\] lacks the joint 'elbow'$"),
    ],
)
def test_tables_that_make_no_robot(tmp_path, old, new, sentence):
    robot = Robot.load(write(tmp_path, held_arms))
    head, tail = robot.config_text.split("[published]\n")
    other = Robot.from_text(robot.urdf, f"{head}[published]\n{tail.replace(old, new, 1)}")
    with pytest.raises(RobotError, match=rf"^robot {robot.name}: {sentence}"):
        Whole(other)


# replay ---------------------------------------------------------------------------------------------------------
def test_replay_by_the_script_of_its_readme(flip, bhr, odd_folder, monkeypatch):
    pybullet = pytest.importorskip("pybullet")
    folder = export.write("urdf-replay", flip, bhr, odd_folder / "replay")
    script = (folder / "replay.py").read_text()
    assert len(script.splitlines()) <= 10
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["replay.py", "--no-window"])
    space = {}
    try:
        exec(script, space)
        last = Motion.of(flip).every(100.0, end=True).q[-1]
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
             phase=np.array(["landing"] * n), foot_wrench=np.ones((n, 2, 6)),
             joint_names=np.array(p.robot.joint_names))  # fmt: skip
    return folder


def test_command(capsys, plan, tmp_path):
    duration = store.read_plan(plan)[0].t[-1]
    for format_name in ("asap-pkl", "mujoco"):  # a file, and a folder
        out = tmp_path / "new" / export.FORMATS[format_name][0]
        code, said, err = run(capsys, "export", plan, "--format", format_name, "--out", out)
        assert (code, err) == (0, "") and out.exists()
        assert said == f"plan to touchdown, {duration:.3f} s, as {format_name}: {out}\n"
    code, said, err = run(capsys, "export", plan, "--format", "csv", "--simulated")
    assert (code, err) == (0, "") and said.startswith("simulation, 0.029 s, as csv: ")
    table = np.genfromtxt(plan / "simulated_joints.csv", delimiter=",", names=True)
    assert len(table) == 30 and set(table["phase_0_launch_1_flight_2_landing"]) == {2}
    assert np.isfinite(table["left_foot_force_z_N"]).all() and 0.2 < table["com_z_m"].min() < table["base_z_m"].max()
    (plan / "simulated_joints.csv").unlink()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--format", "mjlab-npz", "--fps", "many"], "--fps must be a number, got 'many'"),
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
