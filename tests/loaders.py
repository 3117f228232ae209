"""Do trackers load what is exported? For an environment that has them, and numpy: ``python tests/loaders.py DIR``.

DIR is a result folder with exports of a G1's simulation in all formats for trackers. Loaders that are not installed are
named; what is loaded is compared between the formats, and names with those of the trackers' own G1.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np


def close(name: str, found: np.ndarray, expected: np.ndarray, limit: float = 2e-5) -> None:
    """Refuse arrays that differ."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape, f"{name}: {found.shape}, not {expected.shape}"
    worst = float(np.abs(found - expected).max())
    assert worst < limit, f"{name}: {worst:g} apart"


def mjlab(folder: Path) -> str:
    """Its motion loader on the npz in both orders, names by its own G1, and its reader of the CSV."""
    import mujoco
    import torch
    from mjlab.asset_zoo.robots.unitree_g1.g1_constants import get_spec
    from mjlab.scripts.csv_to_npz import MotionLoader as Rows
    from mjlab.tasks.tracking.mdp.commands import MotionLoader

    model = get_spec().compile()
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    hinges = [i for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE]
    for name in ("mjlab", "beyondmimic"):
        raw = np.load(folder / f"simulated_{name}.npz")
        assert name != "mjlab" or list(raw["body_names"]) == bodies
        assert name != "mjlab" or list(raw["joint_names"]) == [model.joint(i).name for i in hinges]
        order = [list(raw["body_names"]).index(body) for body in bodies]
        motion = MotionLoader(str(folder / f"simulated_{name}.npz"), torch.tensor(order))
        assert motion.time_step_total == len(raw["joint_pos"]) and motion.time_step_total / raw["fps"][0] > 3.0
        close("places", motion.body_pos_w, np.load(folder / "simulated_mjlab.npz")["body_pos_w"])
        close("joints", motion.joint_pos, raw["joint_pos"])
    rows = Rows(str(folder / "simulated_unitree.csv"), 30, 50, "cpu")
    long = np.load(folder / "simulated_mjlab.npz")["joint_pos"]
    close("joints at the start", rows.motion_dof_poss[0], long[0])
    return f"{motion.time_step_total} frames, {len(bodies)} bodies, {len(hinges)} joints"


def wbc_mjlab(folder: Path) -> str:
    """Its readers of the CSV, the pickle and the npz."""
    from wbc_mjlab.motion.motion_formats import load_motion_clip
    from wbc_mjlab.motion.stack_bundle import load_motion_clip_npz

    one, other = (load_motion_clip(folder / f"simulated_{name}") for name in ("unitree.csv", "gmr.pkl"))
    for name in ("base_pos", "base_rot_xyzw", "dof_pos"):
        close(name, getattr(one, name), getattr(other, name))
    clip = load_motion_clip_npz(folder / "simulated_mjlab.npz")
    assert one.fps == other.fps == 30 and clip.joint_names == other.source_joint_names
    close("joints at the start", clip.log["joint_pos"][0], other.dof_pos[0])
    return f"{len(one.dof_pos)} frames, {one.dof_pos.shape[1]} joints"


def holosoma(folder: Path) -> str:
    """Its motion loader by the joints and bodies of the npz."""
    from holosoma.managers.command.terms.wbt import MotionLoader

    path = folder / "simulated_holosoma.npz"
    raw, like = np.load(path), np.load(folder / "simulated_mjlab.npz")
    motion = MotionLoader(str(path), list(raw["body_names"][1:]), list(raw["joint_names"]))
    close("joints", motion.joint_pos, like["joint_pos"])
    close("rates", motion.joint_vel, like["joint_vel"])
    close("places", motion.body_pos_w, like["body_pos_w"])
    close("attitudes", motion.body_quat_w.numpy()[..., [3, 0, 1, 2]], like["body_quat_w"])
    return f"{motion.time_step_total} frames, {len(raw['body_names'])} bodies with the world"


def mujoco(folder: Path) -> str:
    """The XML, in which every frame has its bodies where the npz has them."""
    import mujoco as engine

    model = engine.MjModel.from_xml_path(str(folder / "simulated_mujoco" / "robot.xml"))
    x, like = np.load(folder / "simulated_mujoco" / "motion.npz"), np.load(folder / "simulated_mjlab.npz")
    data = engine.MjData(model)
    for k, (q, v, torque) in enumerate(zip(x["qpos"], x["qvel"], x["ctrl"], strict=True)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, torque
        engine.mj_forward(model, data)
        close("places", data.xpos[1:], like["body_pos_w"][k], 1e-5)
    return f"{len(x['qpos'])} frames, {model.nbody - 1} bodies, {model.nu} motors"


LOADERS: tuple[Callable[[Path], str], ...] = (mujoco, wbc_mjlab, mjlab, holosoma)

if __name__ == "__main__":
    for loader in LOADERS:
        try:
            print(f"{loader.__name__}: {loader(Path(sys.argv[1]))}", flush=True)
        except ImportError as e:
            print(f"{loader.__name__}: not installed ({e})", flush=True)
