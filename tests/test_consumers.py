"""Clips as two trainers take them, by what their published reading code asks for; and files of ``torch.save``."""

import io
import pickle
import zipfile

import mujoco
import numpy as np
import pytest
from fixtures_core import jump, refused
from scipy.spatial.transform import Rotation

from jumplab.io import export
from jumplab.io import folder as store
from jumplab.io.clip import read_clips
from jumplab.io.motion import Motion
from jumplab.io.tensors import read_tensors, tensor_file
from jumplab.io.whole import Whole
from jumplab.robot.stance import stance_configuration

# of ProtoMotions' own filter of motions: heights [m], speeds [m/s, rad/s], and time in the air [s] above a height
LOWEST_M, FASTEST_M_S, FASTEST_RAD_S, FLOAT_M, FLOAT_S = -0.05, 15.0, 40.0, 0.2, 1.0


def plan():
    return jump(0.6, 0.3)


def test_protomotions_takes_the_motion_and_its_filter_keeps_it(tmp_path):
    path = export.write("protomotions", Motion.of(plan().tape), plan().robot, tmp_path / "hop.motion")
    x = read_tensors(path.read_bytes())
    frames, joints = x["dof_pos"].shape
    shapes = {"pos": 3, "rot": 4, "vel": 3, "ang_vel": 3}
    for name, width in shapes.items():
        assert x[f"rigid_body_{name}"].shape == (frames, joints + 1, width) and x[f"rigid_body_{name}"].dtype == "f4"
    assert x["fps"] == 30 and x["dof_vel"].shape == (frames, joints)
    touching = x["rigid_body_contacts"]
    assert touching.dtype == bool and touching.shape == (frames, joints + 1)
    feet = [list(Whole(plan().robot).links).index(name) for name in plan().robot.foot.frames]
    flying = Motion.of(plan().tape).every(30, end=True).phase == "flight"
    assert (touching[:, feet] == ~flying[:, None]).all() and touching.sum() == 2 * (~flying).sum()
    place = x["rigid_body_pos"]
    assert place[..., 2].min() > LOWEST_M and np.abs(np.diff(place, axis=0) * 30).max() < FASTEST_M_S
    assert np.abs(x["dof_vel"]).max() < FASTEST_RAD_S
    height = place[..., 2].min(axis=1)
    assert (height - height.min() > FLOAT_M).sum() < FLOAT_S * 30
    assert np.allclose(np.linalg.norm(x["rigid_body_rot"], axis=-1), 1, atol=1e-6)


def test_unilab_takes_the_clip_by_mujocos_numbers_of_bodies(tmp_path):
    path = export.write("unilab-npz", Motion.of(plan().tape), plan().robot, tmp_path / "hop.npz")
    with np.load(path) as x:
        assert int(np.asarray(x["fps"]).reshape(-1)[0]) == 50
        frames, joints = x["joint_pos"].shape
        assert joints == len(x["joint_names"]) and x["joint_vel"].shape == (frames, joints)
        assert {len(x[f"body_{name}_w"]) for name in ("pos", "quat", "lin_vel", "ang_vel")} == {frames}
        assert x["body_pos_w"].shape[1] == joints + 2 and x["body_names"][0] == "world"  # body 0 of MuJoCo
        bare = {name: x[name] for name in x.files if name not in ("joint_names", "body_names")}
    np.savez(tmp_path / "bare.npz", **bare)  # as UniLab itself writes them
    for one, other in zip(read_clips(path, plan().robot), read_clips(tmp_path / "bare.npz", plan().robot), strict=True):
        assert np.array_equal(one.q, other.q)


# files of torch.save
# ----------------------------------------------------------------------------------------------------------------------
CONTENT = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.array([[True], [False]]),
    "c": np.arange(3),
    "fps": 30,
    "name": "hop",
}


def test_arrays_come_back():
    for name, value in read_tensors(tensor_file(CONTENT)).items():
        assert np.array_equal(value, CONTENT[name]) and np.asarray(value).dtype == np.asarray(CONTENT[name]).dtype


def test_pytorch_reads_and_writes_the_same(tmp_path):
    torch = pytest.importorskip("torch")
    (tmp_path / "x.motion").write_bytes(tensor_file(CONTENT))
    there = torch.load(tmp_path / "x.motion", weights_only=True)
    assert all(np.array_equal(np.asarray(there[name]), value) for name, value in CONTENT.items())
    torch.save({"turned": torch.arange(6.0).reshape(2, 3).T, "rows": torch.arange(6)[2:4]}, tmp_path / "y.motion")
    back = read_tensors((tmp_path / "y.motion").read_bytes())
    assert back["turned"].tolist() == [[0, 3], [1, 4], [2, 5]] and back["rows"].tolist() == [2, 3]


def torch_like(index: bytes, numbers: bytes = b"") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("x/data.pkl", index)
        file.writestr("x/data/0", numbers)
    return buffer.getvalue()


class Code:
    """Functions that a pickle may run."""

    def __reduce__(self):
        import os

        return os.mkdir, ("it_ran",)


def test_tensors_with_code_or_of_the_wrong_size_are_refused(bhr, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bad.motion"
    path.write_bytes(torch_like(pickle.dumps({"dof_pos": Code()})))
    assert "bad.motion: refused, it names posix.mkdir, which could run code" in refused(read_clips, path, bhr)
    assert not (tmp_path / "it_ran").exists()
    with zipfile.ZipFile(io.BytesIO(tensor_file({"a": CONTENT["a"]}))) as file:
        index = file.read("archive/data.pkl")
    path.write_bytes(torch_like(index, b"1234"))
    assert "bad.motion: not a readable clip (ValueError)" in refused(read_clips, path, bhr)
    with zipfile.ZipFile(io.BytesIO(tensor_file({"a": np.ones(1)}))) as file:
        index, one = file.read("archive/data.pkl"), file.read("archive/data/0")
    shape, stride = (pickle.dumps(x, protocol=2)[2:-1] for x in ((1,), (1,)))
    assert shape + stride in index
    many, still = (pickle.dumps(x, protocol=2)[2:-1] for x in ((10**10,), (0,)))
    path.write_bytes(torch_like(index.replace(shape + stride, many + still), one))  # 80 GB, of one number
    assert "bad.motion: not a readable clip (ValueError)" in refused(read_clips, path, bhr)


# platforms
# ----------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("way", "top"), [([0.6, 0.0, 0.3], 0.3), ([0.0, 0.5, -0.2], -0.2), ([0.4, 0.0, 0.0], None)])
def test_the_surface_on_which_a_motion_ends_goes_with_it(way, top, bhr, tmp_path):
    q = np.tile(stance_configuration(bhr), (12, 1))
    q[:, :3] += np.linspace(0, 1, 12)[:, None] * way
    none = np.zeros((12, bhr.model.nv))
    motion = Motion(np.arange(12) / 50, q, none, none[:, 6:], np.full(12, "launch"), "plan")
    folder = export.write("mujoco", motion, bhr, tmp_path / "mujoco")
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    files = [export.write(name, motion, bhr, tmp_path / f"{name}.npz") for name in ("unilab-npz", "holosoma-npz")]
    arrays = [np.load(file) for file in files]
    if top is None:
        assert "platform" not in [model.geom(k).name for k in range(model.ngeom)]
        assert not [name for x in arrays for name in x.files if name.startswith("object")]
        assert not [*tmp_path.glob("*.obj")]
        return
    box = model.geom("platform")
    assert box.pos[2] + box.size[2] == pytest.approx(max(top, 0), abs=1e-6)
    assert model.geom("ground").pos[2] == pytest.approx(min(top, 0), abs=1e-6)
    turn = Rotation.from_quat(np.roll(box.quat, -1))
    whole = Whole(bhr)
    on = whole.soles(motion.q[-1 if top > 0 else 0]), whole.soles(motion.q[0 if top > 0 else -1])
    own, other = (np.abs(turn.inv().apply(x.reshape(-1, 3) - box.pos))[:, :2] for x in on)
    assert (own < box.size[:2] - 0.03).all() and (other > box.size[:2]).any(axis=1).all()
    for x in arrays:
        assert x["object_pos_w"][-1] == pytest.approx(box.pos, abs=1e-6) and x["object_quat_w"].shape == (12, 4)
        assert not x["object_lin_vel_w"].any() and not x["object_ang_vel_w"].any()
    for file, x in zip(files, arrays, strict=True):
        points, faces = mesh_of(file.with_name(f"{file.stem}_platform.obj"))
        assert np.abs(points).max(axis=0) == pytest.approx(box.size, rel=1e-6)
        places = Rotation.from_quat(np.roll(x["object_quat_w"][0], -1)).apply(points) + x["object_pos_w"][0]
        assert (places[:, 2].min(), places[:, 2].max()) == pytest.approx((min(top, 0), max(top, 0)), abs=1e-6)
        a, b, c, _ = points[faces].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        middles = points[faces].mean(axis=1)
        assert ((normals * middles).sum(axis=1) > 0).all()  # outside is outside
        assert (normals * middles).sum() / 3 == pytest.approx(8 * np.prod(box.size))  # its volume
    level = Motion(motion.t, np.tile(q[:1], (12, 1)), none, none[:, 6:], motion.phase, "plan")
    export.write("unilab-npz", level, bhr, files[0])
    assert [file.name for file in tmp_path.glob("*.obj")] == ["holosoma-npz_platform.obj"]


def mesh_of(path):
    """Points (n, 3) and four-cornered faces (m, 4) of an OBJ file."""
    rows = [line.split() for line in path.read_text().splitlines()]
    points = np.array([row[1:] for row in rows if row[0] == "v"], float)
    return points, np.array([row[1:] for row in rows if row[0] == "f"], int) - 1


def test_the_mesh_of_a_platform_goes_with_the_plan_that_it_was_made_for(tmp_path):
    for name in ("unilab_platform.obj", "simulated_holosoma_platform.obj"):
        assert name in store.OF_PLAN
    assert "simulated_unilab_platform.obj" in store.OF_SIMULATION
