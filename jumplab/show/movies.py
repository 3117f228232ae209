"""A jump as a moving picture, MP4 or GIF: the bodies of the 3-D page, drawn by MuJoCo without a
display.

>>> jl.plots.movie(robot, run, scene).save("jump.gif")
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module, resources
from pathlib import Path
from typing import TYPE_CHECKING

import imageio.v3 as images
import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter1d

from jumplab.arguments import checked
from jumplab.errors import InputError, require_type
from jumplab.io.files import settle, write_file
from jumplab.io.motion import Motion, Record
from jumplab.io.progress import tell
from jumplab.robot import Robot
from jumplab.show.shapes import PAINTS, parts_of, trace
from jumplab.show.style import INK
from jumplab.sim.scene import Scene

if TYPE_CHECKING:
    import mujoco

KINDS = {"gif": ("image/gif", (480, 270)), "mp4": ("video/mp4", (848, 480))}  # type, size [pixels]
RATES = {"gif": 20.0, "mp4": 30.0}  # frames a second
LIBRARIES = {"egl": "MuJoCo, EGL", "osmesa": "MuJoCo, OSMesa"}  # of OpenGL without a display
# how fast it is shown, and how much of the standing
SPEED = 0.5
AFTER_TOUCHDOWN_S = 0.8
# the camera: distance, direction
VIEW_M = 3.5
AZIMUTH_DEG = 115.0
TILT_DEG = -9.0
GLIDE_S = 0.25  # the camera follows the trunk, smoothed over this time
SHOWN_M = -6.0, 8.0  # of the ground
COLORS = 64  # of a GIF: more is larger, and looks the same


@checked
@dataclass(frozen=True)
class Movie:
    """A finished moving picture; a notebook shows it, :meth:`save` writes it."""

    data: bytes = field(repr=False)
    kind: str  # "gif" or "mp4"
    frames: int
    seconds: float  # it lasts
    drawn_by: str

    def save(self, path: str | Path) -> Path:
        """Write the file (whole or not at all); raises :class:`InputError` if that cannot be."""
        return write_file(path, self.data)

    def _repr_html_(self) -> str:
        source = f"data:{KINDS[self.kind][0]};base64,{base64.b64encode(self.data).decode()}"
        look = f'src="{source}" style="max-width: 100%"'
        if self.kind == "gif":
            return f'<img {look} alt="the jump">'
        return f"<video {look} controls loop autoplay muted playsinline></video>"


@checked
def movie(
    robot: Robot, record: Record | Motion, scene: Scene | None = None, kind: str = "gif"
) -> Movie:
    """A planned or simulated jump at half its speed, until it stands; launch, flight and landing in
    their colours.

    ``kind`` is "gif" or "mp4" (20 or 30 frames a second). Raises :class:`InputError` for another
    one, or where nothing can draw.
    """
    require_type(robot, Robot, "the robot of a movie")
    if kind not in KINDS:
        raise InputError(f"a movie must be one of {', '.join(KINDS)}, got {kind!r}")
    motion = Motion.of(record)
    motion = motion.every(RATES[kind] / SPEED)
    landing = motion.t[motion.phase == "landing"]
    shown = motion.t <= (landing[0] + AFTER_TOUCHDOWN_S if len(landing) else np.inf)
    q = motion.q[shown]
    # where the camera looks [m]
    width = max(1, round(GLIDE_S * RATES[kind] / SPEED)) | 1
    ahead = uniform_filter1d(motion.q[:, 0], width, mode="nearest")[shown]
    rise = np.maximum(0.0, q[:, 2] - q[0, 2])
    looks = np.column_stack([ahead, 0 * rise, 0.85 * q[0, 2] + 0.35 * rise])
    pictures = []
    name, renderer = _renderer(_world(robot, scene or Scene.flat()), KINDS[kind][1])
    with renderer:
        rows = zip(motion.t, trace(robot, q).joints, looks, motion.phase, strict=False)
        for k, (t, poses, look, phase) in enumerate(rows, start=1):
            tell("drawing frame", k, len(q))
            picture = Image.fromarray(_draw(renderer, poses, look, str(phase)))
            words = f"{t - motion.t[0]:.2f} s  (half speed)"
            ImageDraw.Draw(picture).text((10, picture.height - 22), words, fill=INK)
            pictures.append(picture)
    return Movie(_encode(pictures, kind), kind, len(q), len(q) / RATES[kind], name)


def write_movie(
    path: str | Path, robot: Robot, record: Record | Motion, scene: Scene | None = None
) -> Movie:
    """Draw a :func:`movie` (its kind is the ending of ``path``) and write it."""
    film = movie(robot, record, scene, Path(path).suffix.lower().removeprefix("."))
    settle()
    film.save(path)
    return film


def _encode(pictures: Sequence[Image.Image], kind: str) -> bytes:
    if kind == "mp4":
        coding = dict(codec="libx264", pixelformat="yuv420p", macro_block_size=2, fps=RATES[kind])
        frames = np.stack([np.asarray(picture) for picture in pictures])
        return images.imwrite("<bytes>", frames, extension=".mp4", plugin="FFMPEG", **coding)
    some = np.vstack([np.asarray(p) for p in pictures[:: max(1, len(pictures) // 6)]])
    palette = Image.fromarray(some).quantize(COLORS)
    plain = dict(palette=palette, dither=Image.Dither.NONE)
    first, *others = (picture.quantize(**plain) for picture in pictures)
    pause = round(1000 / RATES[kind])  # [ms]
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=pause, loop=0)
    return buffer.getvalue()


# what draws
# ----------------------------------------------------------------------------------------------
def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> tuple[str, mujoco.Renderer]:
    """MuJoCo's renderer with the first library that works on this machine, and its name."""
    import mujoco
    from mujoco.rendering.classic import gl_context

    failures = []
    for library, name in LIBRARIES.items():
        try:
            # else chosen by an environment variable that is read when MuJoCo is imported
            gl_context.GLContext = import_module(f"mujoco.{library}").GLContext
            return name, mujoco.Renderer(model, size[1], size[0])
        except Exception as e:  # drivers that are not there fail in many ways
            failures.append(f"{name} ({type(e).__name__})")
    raise InputError(
        f"nothing here can draw a movie: {', '.join(failures)}; install libegl1 or libosmesa6"
    )


def _draw(renderer: mujoco.Renderer, poses: np.ndarray, look: np.ndarray, phase: str) -> np.ndarray:
    """Pixels (h, w, 3) of the joints at ``poses`` (njoints - 1, 7), seen at ``look`` (3,) [m]."""
    import mujoco

    model = renderer.model
    for kind, color in PAINTS[phase].items():
        model.material(kind).rgba = (*color, 1.0)
    data = mujoco.MjData(model)
    data.mocap_pos = poses[:, :3]
    data.mocap_quat = poses[:, [6, 3, 4, 5]]
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.distance = VIEW_M
    camera.azimuth = AZIMUTH_DEG
    camera.elevation = TILT_DEG
    camera.lookat = look
    renderer.update_scene(data, camera)
    return renderer.render()


def _world(robot: Robot, scene: Scene) -> mujoco.MjModel:
    """Sky and light of ``world.xml``, the ground, and the robot's parts on a body per joint."""
    import mujoco

    text = (resources.files("jumplab.show") / "world.xml").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(text)
    for half, middle, turn in scene.within(*SHOWN_M, 4.0).boxes():
        place = dict(size=half, pos=middle, quat=np.roll(turn, 1))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, material="floor", **place)
    bodies = [spec.worldbody.add_body(mocap=True) for _ in range(1, robot.model.njoints)]
    for number, part in enumerate(parts_of(robot)[0]):
        surface = dict(uservert=part.points.ravel(), userface=part.triangles.ravel())
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open surfaces too
        spec.add_mesh(name=f"{number}", inertia=shell, **surface)
        look = dict(meshname=f"{number}", material=part.kind, contype=0, conaffinity=0)
        bodies[part.joint - 1].add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, **look)
    return spec.compile()
