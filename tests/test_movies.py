"""Moving pictures: drawn without a display, of the right size and length."""

import io
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from fixtures_core import jump, refused
from PIL import Image
from scipy.spatial import Delaunay

import jumplab as jl
from jumplab.errors import InputError
from jumplab.robot.files import LEG
from jumplab.show import movies, shapes


@pytest.fixture(scope="module")
def plan():
    """0.2 s before take-off and 0.2 s after it."""
    whole = jump(1.0, 0.5)
    rows = slice(whole.tape.takeoff_index - 200, whole.tape.takeoff_index + 200)
    cut = {name: getattr(whole.tape, name)[rows] for name in ("t", "q", "v", "a", "tau", "phase", "f")}
    return replace(whole, tape=replace(whole.tape, **cut))


def frames(data):
    image = Image.open(io.BytesIO(data))
    out = []
    for k in range(image.n_frames):
        image.seek(k)
        out.append(np.asarray(image.convert("RGB"), float))
    return np.array(out)


@pytest.mark.slow
def test_a_gif_shows_the_robot_move(plan):
    made = jl.plots.movie(plan, forces=True)
    assert made.drawn_by in movies.LIBRARIES.values()
    seen = frames(made.data)
    assert seen.shape[1:] == (270, 480, 3) and made.frames == len(seen) and len(made.data) < 1.5e6
    assert made.seconds == pytest.approx(2 * (plan.t[-1] - plan.t[0]), abs=0.1)  # at half speed
    blue, orange = (seen[k][..., 2] > seen[k][..., 0] + 60 for k in (0, -1)), seen[-1][..., 0] > seen[-1][..., 2] + 60
    assert next(blue).sum() > 500 and orange.sum() > 500  # launch blue, flight orange
    assert np.abs(np.diff(seen, axis=0)).max(axis=(1, 2, 3)).min() > 0  # no frame is the one before
    assert made._repr_html_().startswith('<img src="data:image/gif;base64,')


@pytest.mark.slow
def test_an_mp4_is_one(plan, tmp_path):
    made = movies.write_movie(tmp_path / "jump.mp4", plan.robot, plan.tape)
    data = (tmp_path / "jump.mp4").read_bytes()
    assert data == made.data and data[4:8] == b"ftyp" and "<video" in made._repr_html_()


def test_refusals(plan, monkeypatch):
    assert refused(jl.plots.movie, plan.robot, plan.tape, kind="avi") == "a movie must be one of gif, mp4, got 'avi'"
    assert refused(jl.plots.movie, plan.robot) == "a movie of a robot needs its record, a tape or a simulation"
    with pytest.raises(InputError, match=r"^a movie of a plan or a simulation takes no other record; leave"):
        jl.plots.movie(plan, plan.tape)
    monkeypatch.setattr(movies, "import_module", lambda name: (_ for _ in ()).throw(ImportError("none")))
    with pytest.raises(InputError, match=r"^nothing here can draw a movie: MuJoCo, EGL .* libosmesa6$"):
        jl.plots.movie(plan.robot, plan.tape)


def test_a_camera_that_stands_still_sees_all_of_a_short_jump_and_follows_a_long_one(plan):
    way = movies.trace(plan.robot, plan.tape.q)
    looks, distance = movies.camera(way, 100.0)
    assert np.ptp(looks, axis=0).max() == 0 and 2.0 < distance < 6.0
    far = way.joints.copy()
    far[..., 0] += np.linspace(0, 5, len(far))[:, None]
    looks, _ = movies.camera(way._replace(joints=far), 100.0)
    assert np.abs(looks[:, 0] - far[:, 0, 0]).max() < 0.2 and np.ptp(looks[:, 2]) == 0


def test_limbs_of_a_drawn_body_touch_at_every_joint(plan):
    """The parts of two links that a pitch joint joins both hold its place."""
    robot = plan.robot
    parts = shapes.rounded_body(robot)
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model))
    for role in LEG[1:]:
        for joint in map(model.getJointId, robot.joints[role]):
            place = data.oMi[joint].translation
            holding = {
                part.joint
                for part in parts
                if part.kind != "trunk" and Delaunay(part.points).find_simplex(data.oMi[part.joint].actInv(place)) >= 0
            }
            assert model.parents[joint] in holding and len(holding) >= 2, model.names[joint]
