"""A jump as an animation, MP4 or GIF: the bodies of the 3-D page, drawn by MuJoCo without a
display.

>>> jl.plots.movie(run).save("jump.gif")
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v3 as images
import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter1d

from jumplab.arguments import checked
from jumplab.errors import InputError
from jumplab.forms import filled
from jumplab.io.files import settle, write_file
from jumplab.io.motion import Motion, Record
from jumplab.io.progress import tell
from jumplab.robot import Robot
from jumplab.show.shapes import PAINTS, Trace, ground_forces, parts_of, trace
from jumplab.show.style import INK
from jumplab.sim.checks import ground_of
from jumplab.sim.scene import Scene
from jumplab.stages.plan import JumpPlan

if TYPE_CHECKING:
    import mujoco

    from jumplab.sim import SimulationResult

# type, size [pixels], frames a second
KINDS = {"gif": ("image/gif", (480, 270), 20.0), "mp4": ("video/mp4", (848, 480), 30.0)}
LIBRARIES = {"egl": "MuJoCo, EGL", "osmesa": "MuJoCo, OSMesa"}  # of OpenGL without a display
# how fast it is shown, and how much of the standing
SPEED = 0.5
AFTER_TOUCHDOWN_S = 0.8
# the camera: direction, opening (also in world.xml), and how much is seen around the jump
AZIMUTH_DEG = 110.0
TILT_DEG = -9.0
OPENING_DEG = 36.0
# in heights of the highest joint of the robot that stands
HEAD = 0.44  # above the highest joint
LOW = 0.24  # below the lowest
AROUND = 1.1  # before and behind the jump, together
FIXED_M = 2.0  # jumps up to this length are seen by a camera that stands still
GLIDE_S = 0.25  # of longer ones it follows the trunk, smoothed over this time
SHOWN_M = -6.0, 8.0  # of the ground
FINER = 2  # frames are drawn larger by this, and averaged
COLORS = 200  # of a GIF: with 64 the shading of bodies shows bands, more is larger
# lines across the ground, where the toes start and land, and every so often
MARK_RGBA = (0.835, 0.369, 0.0, 1.0)
LINE_RGBA = (0.62, 0.66, 0.72, 1.0)
LINE_M = 0.5
LINE_HALF_M = np.array([0.008, 0.6, 0.0015])
# arrows of the ground's force: length for the robot's weight, radius
ARROW_M = 0.6
ARROW_RADIUS_M = 0.018
ARROW_RGBA = np.array([0.70, 0.07, 0.37, 0.9], np.float32)


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
        return filled("show/movie.html", kind=self.kind, type=KINDS[self.kind][0], data=self.data)


def movie(
    of: Robot | JumpPlan | SimulationResult,
    record: Record | Motion | None = None,
    scene: Scene | None = None,
    kind: str = "gif",
    *,
    forces: bool = False,
) -> Movie:
    """A planned or simulated jump at half its speed, until it stands; launch, flight and landing in
    their colours, lines across the ground every 0.5 m and where the toes start and land.

    Raises :class:`InputError` for another kind, a robot without a record, or where nothing can
    draw.

    Parameters
    ----------
    of : a plan or a simulation, shown on its own ground; or a robot, whose ``record`` (a tape or a
        simulation) follows.
    scene : another ground; flat if a robot is given and this is None.
    kind : "gif" or "mp4" (20 or 30 frames a second).
    forces : draw the forces of the ground, an arrow for each foot; 0.6 m are the robot's weight.
    """
    if kind not in KINDS:
        raise InputError(f"a movie must be one of {', '.join(KINDS)}, got {kind!r}")
    robot, record, scene = _subject(of, record, scene)
    _, size, fps = KINDS[kind]
    rate = fps / SPEED
    whole = Motion.of(record)
    motion = whole.every(rate)
    landing = motion.t[motion.phase == "landing"]
    shown = motion.t <= (landing[0] + AFTER_TOUCHDOWN_S if len(landing) else np.inf)
    way = trace(robot, motion.q[shown])
    looks, distance_m = camera(way, rate)
    pressed = ground_forces(whole, rate, way, scene) if forces else None
    pictures = []
    name, renderer = _renderer(_world(robot, scene, way.toes(robot)[[0, -1]].tolist()), size)
    with renderer:
        for k, look in enumerate(looks):
            tell("drawing frame", k + 1, len(looks))
            arrows = () if pressed is None else _arrows(pressed[k], robot)
            view = _camera_at(look, distance_m)
            picture = _draw(renderer, way.joints[k], view, str(motion.phase[k]), arrows)
            words = f"{motion.t[k] - motion.t[0]:.2f} s, half speed"
            ImageDraw.Draw(picture).text((10, size[1] - 22), words, fill=INK)
            pictures.append(picture)
    count = len(pictures)
    return Movie(_encode(pictures, kind, fps), kind, count, count / fps, name)


def _subject(of: Any, record: Any, scene: Scene | None) -> tuple[Robot, Any, Scene]:
    """The robot, its record and the ground of a movie."""
    if isinstance(of, Robot):
        if record is None:
            raise InputError("a movie of a robot needs its record, a tape or a simulation")
        return of, record, scene or Scene.flat()
    if record is not None:
        raise InputError(
            "a movie of a plan or a simulation takes no other record; leave out record"
        )
    if isinstance(of, JumpPlan):
        return of.robot, of.tape, scene or Scene.of_plan(of.summary, of.robot)
    if of.robot is None:
        raise InputError(
            "the robot of this simulation is unknown; pass the robot, and then the simulation"
        )
    return of.robot, of, scene or ground_of(of)


def camera(way: Trace, rate_hz: float) -> tuple[np.ndarray, float]:
    """Points (n, 3) [m] at which the camera looks along the way, and its distance [m]; it stands
    still unless the jump is long.
    """
    base = way.joints[:, 0, :2]
    heights = way.joints[..., 2]
    tall = heights[0].max()  # the highest joint at first
    top = heights.max() + HEAD * tall
    low = heights.min() - LOW * tall
    looks = np.full((len(base), 3), (top + low) / 2)
    looks[:, :2] = (base.min(axis=0) + base.max(axis=0)) / 2
    long = np.ptp(base[:, 0])
    if long > FIXED_M:
        width = max(1, round(GLIDE_S * rate_hz)) | 1
        looks[:, :2] = uniform_filter1d(base, width, axis=0, mode="nearest")
        long = 0.0
    wide, high = KINDS["gif"][1]
    half = max(top - low, (long + AROUND * tall) * high / wide) / 2
    return looks, half / np.tan(np.radians(OPENING_DEG) / 2)


def _arrows(pressed: np.ndarray, robot: Robot) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ends of the arrows of both feet [m], from places and forces (2, 6) [m, N]."""
    scale = ARROW_M / (robot.total_mass * robot.gravity)
    return [(x[:3], x[:3] + scale * x[3:]) for x in pressed if np.isfinite(x).all()]


def write_movie(
    path: str | Path, robot: Robot, record: Record | Motion, scene: Scene | None = None
) -> Movie:
    """Draw a :func:`movie` (its kind is the ending of ``path``) and write it."""
    film = movie(robot, record, scene, Path(path).suffix.lower().removeprefix("."))
    settle()
    film.save(path)
    return film


def _encode(pictures: Sequence[Image.Image], kind: str, fps: float) -> bytes:
    if kind == "mp4":
        return images.imwrite(
            "<bytes>",
            np.stack(pictures),
            extension=".mp4",
            plugin="FFMPEG",
            codec="libx264",
            pixelformat="yuv420p",
            macro_block_size=2,
            fps=fps,
        )
    some = np.vstack(pictures[:: max(1, len(pictures) // 6)])
    palette = Image.fromarray(some).quantize(COLORS)
    first, *others = (x.quantize(palette=palette, dither=Image.Dither.NONE) for x in pictures)
    pause = round(1000 / fps)  # [ms]
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
            return name, mujoco.Renderer(model, FINER * size[1], FINER * size[0])
        except Exception as e:  # drivers that are not there fail in many ways
            failures.append(f"{name} ({type(e).__name__})")
    raise InputError(
        f"nothing here can draw a movie: {', '.join(failures)}; install libegl1 or libosmesa6"
    )


def _camera_at(look: np.ndarray, distance_m: float) -> mujoco.MjvCamera:
    import mujoco

    camera = mujoco.MjvCamera()
    camera.distance = distance_m
    camera.azimuth = AZIMUTH_DEG
    camera.elevation = TILT_DEG
    camera.lookat = look
    return camera


def _draw(
    renderer: mujoco.Renderer,
    poses: np.ndarray,
    camera: mujoco.MjvCamera,
    phase: str,
    arrows: Sequence[tuple[np.ndarray, np.ndarray]],
) -> Image.Image:
    """The joints at ``poses`` (njoints - 1, 7), and arrows [m]."""
    import mujoco

    model = renderer.model
    for kind, color in PAINTS[phase].items():
        model.material(kind).rgba = (*color, 1.0)
    data = mujoco.MjData(model)
    data.mocap_pos = poses[:, :3]
    data.mocap_quat = poses[:, [6, 3, 4, 5]]
    mujoco.mj_forward(model, data)
    renderer.update_scene(data, camera)
    scene = renderer.scene
    kind = mujoco.mjtGeom.mjGEOM_ARROW
    for start, end in arrows:
        arrow = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(arrow, kind, np.zeros(3), np.zeros(3), np.zeros(9), ARROW_RGBA)
        mujoco.mjv_connector(arrow, kind, ARROW_RADIUS_M, start, end)
        scene.ngeom += 1
    return Image.fromarray(renderer.render()).reduce(FINER)


def _world(robot: Robot, scene: Scene, marks_m: Sequence[float]) -> mujoco.MjModel:
    """Sky and light of ``world.xml``, the ground with lines across, counted from the first of the
    marks, and the robot's parts on a body per joint.
    """
    import mujoco

    spec = mujoco.MjSpec.from_string(filled("show/world.xml"))
    box = mujoco.mjtGeom.mjGEOM_BOX
    for half, middle, turn in scene.within(*SHOWN_M, 4.0).boxes():
        quat = np.roll(turn, 1)
        spec.worldbody.add_geom(type=box, material="floor", size=half, pos=middle, quat=quat)
    lines = [(x, 0.0, LINE_RGBA) for x in marks_m[0] + np.arange(*SHOWN_M, LINE_M)]
    for x, lift, color in [*lines, *((x, 0.001, MARK_RGBA) for x in marks_m)]:
        at = [x, 0.0, scene.top_at(x) + lift]
        spec.worldbody.add_geom(type=box, size=LINE_HALF_M, pos=at, rgba=color)
    bodies = [spec.worldbody.add_body(mocap=True) for _ in range(1, robot.model.njoints)]
    for number, part in enumerate(parts_of(robot)[0]):
        mesh = spec.add_mesh(
            name=f"{number}",
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # open surfaces too
            uservert=part.points.ravel(),
            userface=part.triangles.ravel(),
        )
        bodies[part.joint - 1].add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh.name,
            material=part.kind,
            contype=0,
            conaffinity=0,
        )
    return spec.compile()
