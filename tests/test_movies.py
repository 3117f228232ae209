"""Moving pictures: drawn without a display, of the right size and length."""

import io
from dataclasses import replace

import numpy as np
import pytest
from fixtures_core import jump
from PIL import Image

import jumplab as jl
from jumplab.errors import InputError
from jumplab.show import movies


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
    made = jl.plots.movie(plan.robot, plan.tape)
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
    with pytest.raises(InputError, match=r"^a movie must be one of gif, mp4, got 'avi'$"):
        jl.plots.movie(plan.robot, plan.tape, kind="avi")
    monkeypatch.setattr(movies, "import_module", lambda name: (_ for _ in ()).throw(ImportError("none")))
    with pytest.raises(InputError, match=r"^nothing here can draw a movie: MuJoCo, EGL .* libosmesa6$"):
        jl.plots.movie(plan.robot, plan.tape)
