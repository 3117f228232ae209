"""Pictures of stage 2: legible, drawn from the roll-out alone, and showing what they say."""

import cvxpy as cp
import numpy as np
import pytest
from fixtures_core import pendulum
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from paper import drawings
from paper.claims import Start
from paper.tracking import compared

from jumplab import show as plotting
from jumplab.show.style import MIN_FONT_PT
from jumplab.stages.joint_qp import JointMapper, map_to_joints
from jumplab.task import JumpTask

FAR, NEAR = JumpTask(1.0, 0.5), JumpTask(0.5, 0.3)
ROWS = [Start(FAR, "crouch", 30, cost=1.0), Start(FAR, "stage 2", 20, cost=1.0)]
ROWS += [Start(NEAR, "crouch", 50, cost=1.02), Start(NEAR, "stage 2")]
PANELS = {"iterations": "iterations [1]", "cost": "cost [best]"}


@pytest.fixture(scope="module")
def mapped(bhr):
    return map_to_joints(pendulum(1.0, 0.5), bhr)


FIGURES = {
    "snapshots": lambda plan, robot: drawings.mapped_snapshots(plan, robot),
    "snapshots, platform": lambda plan, robot: drawings.mapped_snapshots(plan, robot, 0.2),
    "tracking": lambda plan, robot: drawings.mapped_tracking(plan, pendulum(1.0, 0.5), robot),
    "starts": lambda plan, robot: drawings.guess_comparison(ROWS, PANELS),
}


@pytest.fixture(params=FIGURES)
def figure(request, mapped, bhr, monkeypatch):
    for owner, name in ((JointMapper, "run"), (cp.Problem, "solve")):
        monkeypatch.setattr(owner, name, lambda *args, **kwargs: pytest.fail("a picture has started a computation"))
    fig = FIGURES[request.param](mapped, bhr)
    FigureCanvasAgg(fig).draw()
    return fig


def test_legible_and_within_the_page(figure):
    width, height = figure.get_size_inches()
    assert width <= plotting.PAGE_IN + 1e-9 and height < 5.0
    drawn = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert min(t.get_fontsize() for t in drawn) >= MIN_FONT_PT
    for label in (text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text):
        assert "[" in label, label


def test_snapshots_end_at_touchdown_at_their_true_heights(mapped, bhr):
    (ax,) = drawings.mapped_snapshots(mapped, bhr).axes
    said = [t.get_text() for t in ax.texts]
    assert said[0] == "0.00 s" and f"{mapped.t[-1]:.2f} s" in said and {"launch", "flight"} <= set(said)
    body = plotting.Silhouette(bhr)
    heights = np.concatenate([line.get_ydata() for line in ax.lines if line.get_marker() == "o"])
    assert len(heights) == 11
    assert heights[0] == pytest.approx(body.com(mapped.q[0])[1]) and heights[-1] == pytest.approx(
        body.com(mapped.q[-1])[1]
    )


def test_tracking_shows_reference_dashed_and_the_difference_below(mapped, bhr):
    axes = np.reshape(drawings.mapped_tracking(mapped, pendulum(1.0, 0.5), bhr).axes, (2, 4))
    assert all(any(line.is_dashed() for line in ax.lines) for ax in axes[0])
    difference = np.concatenate([line.get_ydata() for line in axes[1, 1].lines if len(line.get_ydata()) > 2])
    actual, asked = compared(mapped, pendulum(1.0, 0.5), bhr)
    np.testing.assert_allclose(difference, actual["L"] - asked["L"])


def test_starts_without_a_solution_leave_a_gap():
    one, two = drawings.guess_comparison(ROWS, PANELS).axes
    dots = [line.get_ydata() for line in one.lines if line.get_marker() == "o"]
    np.testing.assert_array_equal(dots, [[30, 50], [20, np.nan]])
    assert one.get_ylim()[0] == 0 and 0.8 < two.get_ylim()[0] < 1  # values that hardly differ are not drawn from zero
