"""Pictures of simulated jumps: which frames they show, what their curves say, and what the camera really sees."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.path import Path
from matplotlib.text import Text
from paper import diagrams, experiments, render
from pinocchio import SE3
from scipy.ndimage import binary_dilation

from jumplab import show as plotting
from jumplab.robot.stance import stance_configuration
from jumplab.show.style import MIN_FONT_PT, PHASE_COLORS
from jumplab.sim import Scene
from jumplab.task import JumpTask

TASK = JumpTask(1.0, 0.5)


def smallest_font(fig) -> float:
    return min(t.get_fontsize() for t in fig.findobj(Text) if t.get_text() and t.get_visible())


# ------------------------------------------------------------------------------------------ frames


def test_frames_show_each_phase_and_its_turning_points(simulation):
    rows = render.frame_rows(simulation)
    assert len(rows) == 12 and (np.diff(rows) > 0).all()
    assert [str(p) for p in simulation.phase[rows]] == ["launch"] * 4 + ["flight"] * 4 + ["landing"] * 4
    flight = np.flatnonzero(simulation.phase == "flight")
    assert (rows[0], rows[3], rows[8], rows[-1]) == (0, flight[0] - 1, flight[-1] + 1, len(simulation.t) - 1)
    z = simulation.com[:, 2]
    assert z[rows[1]] == z[: flight[0]].min() and z[rows[9]] == pytest.approx(z[flight[-1] + 1 :].min(), abs=1e-4)
    for low, middle, high in (rows[1:4], rows[9:12]):
        assert z[middle] == pytest.approx((z[low] + z[high]) / 2, abs=0.01)


@pytest.mark.parametrize("end", ["before take-off", "in the air"])
def test_frames_of_half_a_jump_are_evenly_spaced(simulation, end):
    cut = int(np.argmax(simulation.phase == "flight")) + (0 if end == "before take-off" else 300)
    short = replace(simulation, **{k: getattr(simulation, k)[:cut] for k in ("t", "q", "com", "phase")})
    rows = render.frame_rows(short)
    assert len(rows) == 12 and rows[0] == 0 and rows[-1] == cut - 1
    assert np.ptp(np.diff(rows)) <= 1


def test_frames_of_a_fall(simulation):
    """The CoM ends lower than in the deepest knee bend: half-way up does not exist, half of the time does."""
    com = simulation.com.copy()
    com[-1, 2] = 0.1
    rows = render.frame_rows(replace(simulation, com=com))
    assert rows[10] == (rows[9] + rows[11]) // 2


# ------------------------------------------------------------------------------------------ curves


def test_smoothing_keeps_the_impulse():
    force = np.zeros(200)
    force[100], force[0] = 3000.0, 0.0
    mean = experiments.smooth(force, 0.001)
    assert len(mean) == 200 and mean.sum() == pytest.approx(force.sum())
    assert mean[99] == 0 and mean[100] == pytest.approx(150.0) and mean[119] == pytest.approx(150.0)
    assert mean[120] == pytest.approx(0.0, abs=1e-9)
    assert experiments.smooth(np.full(5, 7.0), 0.001) == pytest.approx(7.0)
    assert len(experiments.smooth(np.zeros(0), 0.001)) == 0


def test_trunk_pitch_counts_full_turns():
    angle = np.linspace(0.3, -6.0, 60)
    q = np.zeros((60, 21))
    q[:, 4], q[:, 6] = np.sin(angle / 2), np.cos(angle / 2)
    assert experiments.trunk_pitch(q) == pytest.approx(angle)


def test_landing_figure_tells_what_the_log_says(simulation, good, bhr):
    fig = experiments.landing_loads(simulation, good, bhr)
    pitch, force, bars = fig.axes
    launch = simulation.phase == "launch"
    assert pitch.lines[0].get_ydata() == pytest.approx(np.degrees(experiments.trunk_pitch(simulation.q))[launch])
    impulse = np.trapezoid(force.lines[0].get_ydata() * 1000, simulation.t[launch])
    assert impulse == pytest.approx(simulation.metrics.launch_impulse[1], rel=0.06)  # 20 ms of it show up in the flight
    worst = {}
    for name, share in simulation.metrics.max_torque_ratio_by_joint.items():
        group = name.split("_", 1)[1].replace("_", " ")
        worst[group] = max(worst.get(group, 0.0), share)
    groups = [label.get_text() for label in bars.get_yticklabels()]
    ticks = np.array([line.get_xdata() for line in bars.lines if line.get_marker() == "|"])  # (phase, joint)
    assert dict(zip(groups, ticks.max(axis=0), strict=True)) == pytest.approx(worst)
    widths = np.array([bar.get_width() for bar in bars.patches]).reshape(3, -1)
    assert (widths <= ticks + 1e-12).all() and widths.max() > 0.3
    assert smallest_font(fig) >= MIN_FONT_PT


def test_trials_sort_robots_by_their_fate(simulation):
    m = simulation.metrics
    fell = replace(m, landed=False)
    rows = [m, replace(m, foot_distance_m=0.9), fell, replace(fell, foot_distance_m=None)]
    fig = experiments.trials(rows, TASK, nominal=m)
    (ax,) = fig.axes
    drawn = {line.get_label(): np.column_stack(line.get_data()) for line in ax.lines}
    assert {k: len(v) for k, v in drawn.items()} == {"target": 1, "landed": 2, "fell": 1, "as planned": 1}
    assert drawn["landed"][1] == pytest.approx([0.9, m.com_rise_m])
    assert [len(experiments.trials(some, TASK).axes) for some in ([], rows[3:])] == [1, 1]
    assert smallest_font(fig) >= MIN_FONT_PT


# ------------------------------------------------------------------------------------------ rendering


@pytest.fixture(scope="module")
def studio(bhr):
    return render.Renderer(bhr, marks=(0.5,))


SMALL = render.Camera(pitch_deg=0.0, pixels_per_m=120, bottom=0.01)  # eye level, without the ground's surface


def body(picture):
    return (picture < 0.99).any(axis=2)  # what is neither sky nor outside


def test_camera_sees_the_robot_where_the_log_says(simulation, bhr):
    """Nothing of the outlines by Pinocchio, with the joints' balls, is missing; what is seen beyond is perspective.

    The camera is 10 m away: a near hand, 0.28 m before the jump's plane and 0.9 m off the middle of the picture, is
    drawn 3 pixels too far out, and rounding takes one more.
    """
    camera = render.Camera(width=2.0, bottom=-0.1, top=1.9, pitch_deg=0.0, pixels_per_m=100)
    outlines, square = plotting.Silhouette(bhr), np.ones((3, 3), bool)
    x, z = np.meshgrid((np.arange(200) + 0.5) / 100 - 1.0, 1.9 - (np.arange(200) + 0.5) / 100)
    studio = render.Renderer(bhr, scene=Scene("empty", ()))
    for row in render.frame_rows(simulation)[[0, 1, 5, 9]]:
        q = simulation.q[row]
        seen = body(studio.picture(q, replace(camera, x=float(q[0]))))
        places = np.column_stack([x.ravel() + q[0], z.ravel()])
        inside = [Path(outline).contains_points(places) for _, outline in outlines.outlines(q)]
        balls = [p for name, p in outlines.joints(q).items() if "pitch" in name or "knee" in name]
        inside += [np.hypot(*(places - ball).T) < 0.03 for ball in balls]
        wanted = np.any(inside, axis=0).reshape(seen.shape)
        assert wanted.sum() > 1000
        assert not (seen & ~binary_dilation(wanted, square, iterations=4)).any()
        assert not (wanted & ~binary_dilation(seen, square, iterations=1)).any()


def test_pictures_are_repeatable_and_move_with_the_robot(studio, bhr):
    q = stance_configuration(bhr)
    first = studio.picture(q, render.Camera(pixels_per_m=100))
    assert first.shape == (179, 130, 3) and first.min() >= 0 and first.max() == 1.0
    shifted = q.copy()
    shifted[0] -= 2.0  # four pairs of stripes away from the mark
    moved = studio.picture(shifted, render.Camera(pixels_per_m=100, x=-2.0))
    still = studio.picture(q, render.Camera(pixels_per_m=100))
    assert np.array_equal(first, still)
    assert np.abs(first - moved)[:150].mean() < 2e-3


def test_colours_reach_trunk_and_limbs_but_not_the_feet(studio, bhr):
    q = stance_configuration(bhr)
    own, blue = (studio.picture(q, SMALL, color) for color in (None, PHASE_COLORS["launch"]))
    changed = np.abs(own - blue).max(axis=2) > 0.02
    rows = np.nonzero(changed.any(axis=1))[0]
    feet = SMALL.size[1] - round(0.03 * 120)
    assert changed.sum() > 1000 and rows.max() < feet
    again = studio.picture(q, SMALL)
    assert np.array_equal(own, again)


def test_marks_and_platform_are_drawn_in_their_places(bhr):
    q = stance_configuration(bhr)
    camera = render.Camera(x=0.8, width=1.0, top=0.8, bottom=-0.2, pixels_per_m=200)
    picture = render.Renderer(bhr, scene=Scene.level("platform", {0.75: 0.3}), marks=(1.1,)).picture(q, camera)
    solid = body(picture)
    left, right = solid[:, 40], solid[:, 160]  # x = 0.5 and x = 1.1
    top = [0.8 - np.flatnonzero(column)[0] / 200 for column in (left, right)]
    assert top[1] - top[0] == pytest.approx(0.3, abs=0.03)
    red = (picture[..., 0] > 0.6) & (picture[..., 2] < 0.3)
    assert np.nonzero(red)[1].mean() == pytest.approx(160, abs=3)


def test_the_nearer_body_hides_the_other_and_sizes_follow_perspective():
    """A cube of 0.2 m, 10 m away, before a wall of 0.4 m at 11 m, whichever is drawn first."""
    camera = render.Camera(width=1.0, bottom=-0.5, top=0.5, pitch_deg=0.0, pixels_per_m=100)
    cube, wall = (render._box((-x, y, -x), (x, y + 0.1, x)) for x, y in ((0.1, 0.0), (0.2, 1.0)))
    for order in (1, -1):
        canvas = render._Canvas(camera)
        for corners, color in [(cube, (1.0, 0.0, 0.0)), (wall, (0.0, 0.0, 1.0))][::order]:
            canvas.draw(render.Shape(0, corners, color), SE3.Identity(), np.array(color))
        red, blue = ((canvas.image[..., k] > 0) & (canvas.image[..., 1] == 0) for k in (0, 2))
        assert red.sum() == pytest.approx(40**2, rel=0.02)
        assert (red | blue).sum() == pytest.approx((80 / 1.1) ** 2, rel=0.04)
        towards = 1.6 / np.linalg.norm([0.4, -1.6, 2.4])  # cosine between the faces that are seen, and the lamp
        assert canvas.image[100, 100, 0] == pytest.approx(0.65 + 0.4 * towards)


def test_frame_strip_and_model_can_be_read(simulation, bhr, tmp_path):
    strip = render.frame_strip(simulation, bhr, marks=(0.14, 1.14))
    titles = [ax.get_title() for ax in strip.axes]
    assert len(titles) == 12 and titles[0] == "launch, 0.00 s" and titles[-1].startswith("landing")
    assert all(len(ax.images) == 1 and not ax.axison for ax in strip.axes)
    assert smallest_font(strip) >= MIN_FONT_PT
    width, height = strip.get_size_inches()
    assert width == plotting.PAGE_IN and height < 5
    stored = []
    for folder in ("one", "two"):
        plotting.save_figure(diagrams.simulation_model(bhr), "model", tmp_path / folder)
        stored.append([(tmp_path / folder / f"model.{kind}").read_bytes() for kind in ("png", "pdf")])
    assert stored[0] == stored[1]
