"""A jump as a moving picture, MP4 or GIF, drawn without a display: MuJoCo by EGL or OSMesa, else PyBullet by software.

>>> jl.plots.movie(robot, run, scene).save("jump.gif")
"""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib.colors as mcolors
import numpy as np

from jumplab.errors import InputError, require_type
from jumplab.io.files import settle, write_file
from jumplab.io.motion import Motion, Record
from jumplab.io.progress import tell
from jumplab.robot import Robot
from jumplab.show.style import INK, PHASE_COLORS
from jumplab.sim.scene import Scene

KINDS = {"gif": ("image/gif", (480, 270)), "mp4": ("video/mp4", (848, 480))}  # type, size [pixels]
RATES = {"gif": 20.0, "mp4": 30.0}  # frames a second
SPEED, AFTER_TOUCHDOWN_S = 0.5, 0.8  # how fast it is shown, and how much of the standing
VIEW_M, FIELD_DEG, AZIMUTH_DEG, TILT_DEG = 3.5, 36.0, 115.0, -9.0  # the camera: distance, opening, direction
GLIDE_S = 0.25  # the camera follows the trunk, smoothed over this time
SKY, FLOOR, FLOOR_TOO = (0.93, 0.95, 0.97), (0.86, 0.88, 0.91), (0.80, 0.83, 0.87)
SHOWN_M = -6.0, 8.0  # of the ground
BONE, BONE_M, BONE_COLOR = "bone", 0.03, "#42474F"
COLORS = 64  # of a GIF: more is larger, and looks the same

Draw = Callable[[np.ndarray, np.ndarray, str], np.ndarray]  # q, where to look (3,) and colour to pixels (h, w, 3)


@dataclass(frozen=True)
class Movie:
    """A finished moving picture; a notebook shows it, :meth:`save` writes it."""

    data: bytes = field(repr=False)
    kind: str  # "gif" or "mp4"
    frames: int
    seconds: float  # it lasts
    drawn_by: str

    def save(self, path: str | Path) -> Path:
        """Write the file, whole or not at all; raises :class:`InputError` if that cannot be."""
        return write_file(path, self.data)

    def _repr_html_(self) -> str:
        source = f"data:{KINDS[self.kind][0]};base64,{base64.b64encode(self.data).decode()}"
        if self.kind == "gif":
            return f'<img src="{source}" alt="the jump" style="max-width: 100%">'
        return f'<video src="{source}" style="max-width: 100%" controls loop autoplay muted playsinline></video>'


def movie(robot: Robot, record: Record | Motion, scene: Scene | None = None, kind: str = "gif") -> Movie:
    """A planned or simulated jump at half its speed, until it stands; launch, flight and landing in their colours.

    ``kind`` is "gif" or "mp4". Raises :class:`InputError` for another one, or where nothing can draw.
    """
    require_type(robot, Robot, "the robot of a movie")
    if kind not in KINDS:
        raise InputError(f"a movie must be one of {', '.join(KINDS)}, got {kind!r}")
    motion = record if isinstance(record, Motion) else Motion.of(record)
    motion = motion.every(RATES[kind] / SPEED)
    landing = np.flatnonzero(motion.phase == "landing")
    last = motion.t[landing[0]] + AFTER_TOUCHDOWN_S if len(landing) else np.inf
    rows = np.flatnonzero(motion.t <= last)
    width = max(1, round(GLIDE_S * RATES[kind] / SPEED)) | 1
    x = np.convolve(np.pad(motion.q[:, 0], width // 2, mode="edge"), np.ones(width) / width, mode="valid")
    height, pictures = 0.85 * float(motion.q[0, 2]), []
    with _drawer(robot, scene or Scene.flat(), KINDS[kind][1]) as (name, draw):
        for number, k in enumerate(rows, 1):
            tell("drawing frame", number, len(rows))
            look = np.array([x[k], 0.0, height + 0.35 * max(0.0, motion.q[k, 2] - motion.q[0, 2])])
            picture = draw(motion.q[k], look, PHASE_COLORS[str(motion.phase[k])])
            pictures.append(_signed(picture, f"{motion.t[k] - motion.t[0]:.2f} s  (half speed)"))
    return Movie(_encoded(pictures, kind), kind, len(pictures), len(pictures) / RATES[kind], name)


def write_movie(path: str | Path, robot: Robot, record: Record | Motion, scene: Scene | None = None) -> Movie:
    """Draw a :func:`movie` and write it; its kind is the ending of ``path``."""
    made = movie(robot, record, scene, Path(path).suffix.lower().removeprefix("."))
    settle()
    made.save(path)
    return made


def _signed(picture: np.ndarray, text: str) -> np.ndarray:
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((10, picture.shape[0] - 22), text, fill=INK)
    return np.asarray(image)


def _encoded(pictures: list[np.ndarray], kind: str) -> bytes:
    import imageio.v3 as images
    from PIL import Image

    if kind == "mp4":
        how = dict(plugin="FFMPEG", fps=RATES[kind], codec="libx264", pixelformat="yuv420p", macro_block_size=2)
        with tempfile.TemporaryDirectory() as folder:
            images.imwrite(path := Path(folder, "movie.mp4"), np.stack(pictures), **how)
            return path.read_bytes()
    palette = Image.fromarray(np.vstack(pictures[:: max(1, len(pictures) // 6)])).quantize(COLORS)
    flat = [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    with tempfile.TemporaryFile() as file:
        how = dict(save_all=True, append_images=flat[1:], duration=round(1000 / RATES[kind]), loop=0, optimize=False)
        flat[0].save(file, "GIF", **how)
        file.seek(0)
        return file.read()


# what draws -------------------------------------------------------------------------------------------------------
@contextmanager
def _drawer(robot: Robot, scene: Scene, size: tuple[int, int]) -> Iterator[tuple[str, Draw]]:
    """The first renderer that works on this machine."""
    failed = []
    for name, make in (("MuJoCo, EGL", "egl"), ("MuJoCo, OSMesa", "osmesa"), ("PyBullet", "")):
        try:
            draw, close = _mujoco(robot, scene, size, make) if make else _bullet(robot, scene, size)
        except Exception as e:  # drivers that are not there fail in many ways
            failed.append(f"{name} ({type(e).__name__})")
            continue
        try:
            yield name, draw
        finally:
            close()
        return
    raise InputError(f"nothing here can draw a movie: {', '.join(failed)}; install libegl1 or libosmesa6")


def _mujoco(robot: Robot, scene: Scene, size: tuple[int, int], library: str) -> tuple[Draw, Callable[[], None]]:
    import mujoco

    context = import_module(f"mujoco.{library}").GLContext(*size)
    context.make_current()
    model, angles = _model(robot, scene)
    data, seen, camera = mujoco.MjData(model), mujoco.MjvScene(model, 1000), mujoco.MjvCamera()
    drawing, option = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100), mujoco.MjvOption()
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    rectangle, everything = mujoco.MjrRect(0, 0, *size), mujoco.mjtCatBit.mjCAT_ALL
    camera.distance, camera.azimuth, camera.elevation = VIEW_M, AZIMUTH_DEG, TILT_DEG
    own = [g for g in np.flatnonzero(model.geom_bodyid) if not model.geom(g).name.startswith(BONE)]
    pixels = np.empty((size[1], size[0], 3), np.uint8)

    def draw(q: np.ndarray, look: np.ndarray, color: str) -> np.ndarray:
        data.qpos[:3], data.qpos[3:7], data.qpos[angles] = q[:3], q[[6, 3, 4, 5]], q[7:]
        model.geom_rgba[own] = (*mcolors.to_rgb(color), 1.0)
        mujoco.mj_forward(model, data)
        camera.lookat[:] = look
        mujoco.mjv_updateScene(model, data, option, None, camera, everything, seen)
        mujoco.mjr_render(rectangle, seen, drawing)
        mujoco.mjr_readPixels(pixels, None, rectangle, drawing)
        return pixels[::-1].copy()

    def close() -> None:
        drawing.free()
        context.free()

    return draw, close


def _model(robot: Robot, scene: Scene):
    """MuJoCo's model of robot and scene, for pictures alone, and where its joint angles lie in ``qpos``."""
    import mujoco

    spec = mujoco.MjSpec.from_string(robot.urdf)
    spec.compiler.fusestatic, spec.compiler.discardvisual = False, False
    spec.worldbody.first_body().add_freejoint()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.global_.fovy = FIELD_DEG
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.2] * 3
    spec.visual.headlight.specular = [0.0] * 3
    kinds = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(name="sky", type=kinds[0].mjTEXTURE_SKYBOX, builtin=kinds[1].mjBUILTIN_FLAT, rgb1=SKY, rgb2=SKY,
                     width=64, height=64)  # fmt: skip
    spec.add_texture(name="floor", type=kinds[0].mjTEXTURE_2D, builtin=kinds[1].mjBUILTIN_CHECKER, rgb1=FLOOR,
                     rgb2=FLOOR_TOO, width=256, height=256)  # fmt: skip
    floor = spec.add_material(name="floor", texrepeat=[2.0, 2.0], texuniform=True, reflectance=0.0)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    sun = dict(type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[0.45] * 3, specular=[0.0] * 3, castshadow=True)
    spec.worldbody.add_light(pos=[0.0, -1.0, 6.0], dir=[0.15, 0.3, -1.0], **sun)
    for body in list(spec.bodies)[1:]:
        _add_bones(body)
    for half, middle, turn in scene.within(*SHOWN_M, 4.0).boxes():
        place = dict(size=half, pos=middle, quat=np.roll(turn, 1))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, **place, material="floor")
    model = spec.compile()
    return model, np.array([model.joint(name).qposadr[0] for name in robot.joint_names])


def _add_bones(body: Any) -> None:
    """Rods from a link's joint to those below it, so that the body hangs together."""
    import mujoco

    for number, child in enumerate(body.bodies):
        ends = np.concatenate([np.zeros(3), child.pos])
        if np.linalg.norm(child.pos) > BONE_M:
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE
            look = dict(size=[BONE_M, 0.0, 0.0], rgba=[*mcolors.to_rgb(BONE_COLOR), 1.0])
            body.add_geom(type=kind, fromto=ends, name=f"{BONE} {body.name} {number}", **look)


def _bullet(robot: Robot, scene: Scene, size: tuple[int, int]) -> tuple[Draw, Callable[[], None]]:
    import pybullet as p
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(p.DIRECT)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "robot.urdf").write_text(robot.urdf)
        body = client.loadURDF(str(Path(folder, "robot.urdf")))
    joints = {client.getJointInfo(body, j)[1].decode(): j for j in range(client.getNumJoints(body))}
    for half, middle, turn in scene.within(*SHOWN_M, 1.2).boxes():
        shape = client.createVisualShape(p.GEOM_BOX, halfExtents=half, rgbaColor=[*FLOOR, 1])
        client.createMultiBody(0, -1, shape, middle, turn)
    lens = client.computeProjectionMatrixFOV(FIELD_DEG, size[0] / size[1], 0.1, 30.0)
    base = np.array(client.getDynamicsInfo(body, -1)[3])  # the engine's base is the link's centre of mass

    def draw(q: np.ndarray, look: np.ndarray, color: str, client: BulletClient = client) -> np.ndarray:
        place = client.multiplyTransforms(q[:3], q[3:7], base, [0, 0, 0, 1])
        client.resetBasePositionAndOrientation(body, *place)
        for name, angle in zip(robot.joint_names, q[7:], strict=True):
            client.resetJointState(body, joints[name], angle)
        for link in range(-1, client.getNumJoints(body)):
            client.changeVisualShape(body, link, rgbaColor=(*mcolors.to_rgb(color), 1.0))
        eye = client.computeViewMatrixFromYawPitchRoll(look, VIEW_M, AZIMUTH_DEG - 90.0, TILT_DEG, 0.0, 2)
        how = dict(shadow=1, lightDirection=[0.5, -2.0, 5.0], renderer=p.ER_TINY_RENDERER)
        image = client.getCameraImage(*size, eye, lens, **how)[2]
        return np.asarray(image, np.uint8).reshape(size[1], size[0], 4)[..., :3].copy()

    return draw, lambda: client.disconnect()  # keeps the client, which disconnects when it is forgotten
