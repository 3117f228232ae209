"""Figures: style, legibility, byte-stable files, drawings that agree with the models, and nothing solved on the way."""

import ast
import io
import os
import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import casadi as ca
import cvxpy as cp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from fixtures_core import jump, refused
from IPython.core.formatters import DisplayFormatter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.text import Text
from paper import diagrams, drawings
from paper.srmp_touchdown import touchdown_of_plan

from jumplab import show as plotting
from jumplab.errors import InputError
from jumplab.models.srmp import SrmpState
from jumplab.ocp.nlp import Nlp
from jumplab.robot.reach import postures, reach
from jumplab.robot.stance import configuration, stance_configuration
from jumplab.show import style
from jumplab.sim import simulate_jump
from jumplab.stages.srmp.landing import LandingPlanner
from jumplab.task import JumpTask

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted([*(ROOT / "jumplab" / "show").glob("*.py"), *(ROOT / "notebooks" / "paper").glob("d*.py")])
DATES = re.compile(rb"Matplotlib v|CreationDate|ModDate|Software|20[2-9][0-9]-[01][0-9]-")


@pytest.fixture(scope="module")
def material(bhr):
    """Results to draw: a finished jump, a jump onto a platform, a landing, a short simulation."""
    plan, high = jump(1.0, 0.5), jump(0.6, 0.5, 0.3)
    tape = plan.tape
    result = simulate_jump(tape, bhr, stand_s=0.4)
    landing = LandingPlanner(bhr).plan(touchdown_of_plan(plan.srmp, bhr))
    guess = tape.t[::10], tape.extra["planar_joints"][::10], tape.extra["planar_joint_rates"][::10]
    return dict(plan=plan, high=high, tape=tape, result=result, landing=landing, guess=guess)


FIGURES = {
    "framework": lambda m, r: diagrams.framework(),
    "link_models": lambda m, r: diagrams.link_models(r),
    "pendulum_diagram": lambda m, r: diagrams.pendulum_diagram(),
    "inverted_pendulum": lambda m, r: drawings.inverted_pendulum(m["plan"].srmp),
    "inverted_pendulum, platform": lambda m, r: drawings.inverted_pendulum(m["high"].srmp),
    "launch_strobe": lambda m, r: drawings.launch_strobe(m["plan"].srmp),
    "flight_shaping": lambda m, r: drawings.flight_shaping(m["plan"].srmp),
    "flight_comparison": lambda m, r: drawings.flight_comparison({"flat": m["plan"].srmp, "high": m["high"].srmp}),
    "reach_envelope": lambda m, r: drawings.reach_envelope(reach(r, 2**12), m["plan"].srmp, samples=postures(r, 2**10)),
    "reach_envelope, empty": lambda m, r: drawings.reach_envelope(reach(r, 2**12)),
    "landing_reference": lambda m, r: drawings.landing_reference(m["landing"], m["plan"].srmp.reach),
    "joint_trajectories": lambda m, r: plotting.joint_trajectories(m["tape"], r),
    "joint_trajectories, guess": lambda m, r: plotting.joint_trajectories(m["tape"], r, guess=m["guess"]),
    "inertia_and_momentum": lambda m, r: plotting.inertia_and_momentum(m["tape"]),
    "snapshots": lambda m, r: drawings.snapshots(m["tape"], r),
    "snapshots, platform": lambda m, r: drawings.snapshots(m["high"].tape, r),
    "margins": lambda m, r: plotting.margins(m["tape"], r),
    "contact_comparison": lambda m, r: drawings.contact_comparison(
        {"flat": plotting.ground_reaction(m["tape"], r), "high": plotting.ground_reaction(m["high"].tape, r)}, r
    ),
    "jump_strobe": lambda m, r: plotting.jump_strobe(m["result"], r),
    "momentum": lambda m, r: plotting.momentum(m["result"], m["tape"], r),
}


@pytest.fixture(scope="module", params=FIGURES)
def figure(request, material, bhr):
    """Each figure in turn, drawn while every solver refuses to work."""
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((Nlp, "solve"), (cp.Problem, "solve"), (ca.Function, "call"), (plt, "show")):
            patch.setattr(owner, name, lambda *args, **kwargs: pytest.fail("a picture has started a computation"))
        fig = FIGURES[request.param](material, bhr)
        FigureCanvasAgg(fig).draw()
        yield fig


def texts(fig):
    """Visible texts of a figure that say something."""
    hidden = {t for ax in fig.axes if not ax.axison for t in tick_labels(ax)}
    return [t for t in fig.findobj(Text) if t.get_visible() and t.get_text().strip() and t not in hidden]


def tick_labels(ax):
    """Texts along both axes but the axes' own labels; those outside the view are not drawn."""
    return [t for axis in (ax.xaxis, ax.yaxis) for t in axis.findobj(Text) if t is not axis.label]


def placed_texts(fig):
    """Texts that the package places itself, with their extents [pixels]."""
    ticks = {t for ax in fig.axes for t in tick_labels(ax)}
    return [(t.get_text(), t.get_window_extent()) for t in texts(fig) if t not in ticks]


# what a reader needs ----------------------------------------------------------------------------------------------
def test_figure_can_be_read_in_print(figure):
    """A column or a page wide, labels with units, no text small, cut off at the edge, or on another one.

    Friction has no unit; tick labels are matplotlib's own affair.
    """
    width, height = figure.get_size_inches()
    assert width <= plotting.PAGE_IN + 1e-9 and height < 5.0
    assert min(t.get_fontsize() for t in texts(figure)) >= style.MIN_FONT_PT
    box, slack, placed = figure.bbox, 0.02 * figure.dpi, placed_texts(figure)  # a fiftieth of an inch
    for text, extent in placed:
        assert extent.x0 > box.x0 - slack and extent.x1 < box.x1 + slack, text
        assert extent.y0 > box.y0 - slack and extent.y1 < box.y1 + slack, text
    for (one, a), (other, b) in combinations(placed, 2):
        overlap = [min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)]
        assert min(overlap) < 2.0, f"{one!r} lies on {other!r}"
    for label in (text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text):
        assert "[" in label or label.startswith("friction"), label
    assert plt.get_fignums() == [] and figure._repr_png_().startswith(b"\x89PNG")


# style ------------------------------------------------------------------------------------------------------------
def test_colours_are_okabe_and_ito():
    palette = {to_hex(c).upper() for c in matplotlib.color_sequences["okabe_ito"]}
    assert {plotting.LAUNCH, plotting.FLIGHT, plotting.LANDING, plotting.VERMILION, plotting.SKY} <= palette
    assert plotting.PHASE_COLORS == {"launch": plotting.LAUNCH, "flight": plotting.FLIGHT, "landing": plotting.LANDING}
    used = {c.upper().lstrip("#") for c in re.findall(r"'([0-9A-Fa-f]{6})'", style.STYLE_FILE.read_text())}
    assert {f"#{c}" for c in used} <= palette


def test_style_is_package_data_and_is_used_whatever_the_caller_has():
    assert style.STYLE_FILE.is_file()
    with matplotlib.rc_context({"font.size": 20, "figure.figsize": (9, 9)}):
        fig = diagrams.pendulum_diagram()
        assert {t.get_fontsize() for t in texts(fig)} <= {7.0, 8.0, 9.0}
        assert matplotlib.rcParams["font.size"] == 20
        plotting.use_style()
        assert matplotlib.rcParams["font.size"] == 8
        assert tuple(matplotlib.rcParams["figure.figsize"]) == (3.5, 2.4)


def test_tint_and_shade():
    assert plotting.tint(plotting.LAUNCH, 1.0) == pytest.approx(to_rgb(plotting.LAUNCH))
    assert plotting.tint(plotting.LAUNCH, 0.0) == (1.0, 1.0, 1.0)
    assert plotting.shade(plotting.LAUNCH, 0.0) == (0.0, 0.0, 0.0)


def test_curves_change_colour_with_the_phase():
    ax = plotting.new_figure().subplots()
    phase = np.array(["launch"] * 3 + ["flight"] * 2 + ["landing"])
    lines = plotting.by_phase(ax, np.arange(6.0), np.arange(6.0), phase, linewidth=2.0)
    assert [line.get_color() for line in lines] == [plotting.LAUNCH, plotting.FLIGHT, plotting.LANDING]
    assert [len(line.get_xdata()) for line in lines] == [3, 2, 1]


@pytest.mark.parametrize(
    ("curves", "sentence"),
    [
        ([(np.zeros(3), np.zeros(3))], r"a curve must be \(t, y, phase\), got 2 values"),
        ([(np.zeros(2), np.zeros(2), np.array(["flight"] * 2)), (np.zeros(3),)], r"must be \(t, y\), got 1 values"),
        ([(np.zeros(2), np.zeros(2), np.array(["flight"] * 2)), (np.zeros(3), np.zeros(2))], r"y of a reference must"),
    ],
)
def test_curves_that_lack_something_are_refused(curves, sentence):
    with pytest.raises(InputError, match=sentence):
        plotting.compare(plotting.new_figure().subplots(), *curves)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.name)
def test_sources_neither_show_nor_print(path):
    calls = [n.func for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)]
    names = {getattr(f, "attr", getattr(f, "id", "")) for f in calls}
    assert not names & {"show", "print", "ion", "savefig"} - ({"savefig"} if path.name == "style.py" else set())


def test_every_public_name_is_there():
    """They are loaded when they are first used; another name is refused."""
    assert all(hasattr(plotting, name) for name in plotting.__all__) and set(dir(plotting)) == set(plotting.__all__)
    with pytest.raises(AttributeError, match=r"No jumplab\.show attribute jump_strobes"):
        plotting.jump_strobes  # noqa: B018


# files ------------------------------------------------------------------------------------------------------------
def test_saving_writes_three_files_without_dates(tmp_path, bhr):
    task = JumpTask(-0.2, 0.5, platform_m=0.3, rotation_rad=-2 * np.pi)
    fig = diagrams.pendulum_diagram()
    assert plotting.save_figure(fig, "x", tmp_path / "new" / "folder", "What is seen.", task=task, robot=bhr) is fig
    folder = tmp_path / "new" / "folder"
    assert sorted(p.name for p in folder.iterdir()) == ["x.pdf", "x.png", "x.txt"]
    caption = (folder / "x.txt").read_text().splitlines()
    assert caption[0] == "What is seen."
    target = "0.20 m backward, CoM rise 0.50 m, landing 0.30 m higher, rotation -360 deg"
    assert caption[1] == f"Target: {target}."
    assert caption[2] == f"Robot: bhr, 42.0 kg, description {bhr.hash}."
    assert caption[3].startswith("Made with python 3.") and "casadi" in caption[3]
    for suffix in ("png", "pdf"):
        data = (folder / f"x.{suffix}").read_bytes()
        assert not DATES.search(data)
    pixels = plt.imread(folder / "x.png").shape[1::-1]
    assert pixels == pytest.approx(style.DPI * fig.get_size_inches(), abs=1)


def test_a_notebook_shows_the_caption_below_a_saved_figure(tmp_path):
    """And as the alternative text, escaped; by IPython's own formatter, with the picture once."""
    fig = plotting.new_figure()
    before = DisplayFormatter().format(fig)[0]
    plotting.save_figure(fig, "x", tmp_path, 'Torque < limit, "dashed".')
    after = DisplayFormatter().format(fig)[0]
    words = "Torque &lt; limit, &#34;dashed&#34;."
    assert "image/png" in before and "text/html" not in before and "image/png" not in after
    assert f'alt="{words}"' in after["text/html"] and f"<figcaption>{words}</figcaption>" in after["text/html"]
    assert fig.png() == (tmp_path / "x.png").read_bytes()


@pytest.mark.parametrize("name", ["jump_strobe", "reach_envelope"])
def test_drawn_twice_means_the_same_bytes(name, material, bhr, tmp_path):
    """The layout of a figure that is saved again is that of the first time."""
    made, one, other = [], *(FIGURES[name](material, bhr) for _ in range(2))
    for fig in (one, one, other):
        plotting.save_figure(fig, "x", tmp_path)
        made.append([(tmp_path / f"x.{kind}").read_bytes() for kind in ("png", "pdf")])
    assert made[0] == made[1] == made[2] and not any(DATES.search(data) for data in made[0])


def test_files_are_the_same_in_every_process(tmp_path):
    """Same bytes whatever the hash seed, the caller's settings and the folder's name."""
    code = (
        "import sys, matplotlib; matplotlib.rcParams['font.size'] = float(sys.argv[2]);"
        "from paper import diagrams; from jumplab import show as plotting; from jumplab.robot import Robot;"
        "[plotting.save_figure(f, n, sys.argv[1]) for n, f in"
        " (('a', diagrams.framework()), ('b', diagrams.link_models(Robot.load())))]"
    )
    made = []
    for seed, size in (("1", "8"), ("2", "15")):
        folder = tmp_path / seed
        env = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'notebooks'}", "PYTHONHASHSEED": seed}
        subprocess.run([sys.executable, "-c", code, str(folder), size], env=env, check=True)
        made.append({p.name: p.read_bytes() for p in folder.iterdir()})
    assert made[0] == made[1] and len(made[0]) == 6


def test_captions_of_several_jumps_and_of_none():
    tasks = [JumpTask(1.0, 0.5), JumpTask(0.7, 0.55, 0.5)]
    said = style.caption_text("A and C.", tasks).splitlines()
    assert said[:2] == [
        "A and C.",
        "Targets: 1.00 m forward, CoM rise 0.50 m; 0.70 m forward, CoM rise 0.55 m, landing 0.50 m higher.",
    ]
    assert style.caption_text("", tasks[:1]).startswith("No caption.\nTarget: 1.00 m forward, CoM rise 0.50 m.")
    assert "Target" not in style.caption_text("A drawing.")


@pytest.mark.parametrize("name", ["", "a/b", "../a", ".hidden"])
def test_odd_names_are_refused(tmp_path, name):
    assert "must be a plain file name" in refused(plotting.save_figure, plotting.new_figure(), name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file' is a file; choose a folder$"):
        plotting.save_figure(plotting.new_figure(), "x", tmp_path / "file")


# bodies -----------------------------------------------------------------------------------------------------------
def test_sticks_and_shapes_are_the_same_robot(bhr):
    """Joints and CoM of the five-link drawing and of the full robot's agree on random postures."""
    body, m, random = plotting.Silhouette(bhr), bhr.sagittal, np.random.default_rng(0)
    for _ in range(20):
        angles, toe = random.uniform(-1, 1, 5), random.uniform(-1, 1, 2)
        points, q = plotting.five_link_points(m, angles, toe), configuration(bhr, angles, toe)
        places = body.joints(q)
        for role, name in (
            ("hip_pitch", "hip"),
            ("knee", "knee"),
            ("ankle_pitch", "ankle"),
            ("shoulder_pitch", "shoulder"),
        ):
            assert places[bhr.joints[role][0]] == pytest.approx(points[name], abs=1e-12)
        assert body.com(q) == pytest.approx(points["com"], abs=1e-12)


def test_silhouette_stands_on_the_ground_at_its_full_size(bhr):
    q = stance_configuration(bhr)
    for view, width in (("side", 0.24), ("front", 0.53)):
        points = np.concatenate([outline for _, outline in plotting.Silhouette(bhr, view).outlines(q)])
        assert points[:, 1].min() == pytest.approx(0.0, abs=1e-9)
        assert 1.4 < points[:, 1].max() < 1.5
        assert np.ptp(points[:, 0]) == pytest.approx(width, abs=0.06)


def test_pendulum_drawing_is_the_model(bhr):
    ax, q = plotting.new_figure().subplots(), np.array([0.2, 0.7, 0.5, 0.33])
    points = drawings.draw_srmp(ax, q, plotting.LAUNCH)
    com = SrmpState(42.0, ca.DM(q), ca.DM.zeros(4), ca.DM.zeros(4)).com.full().ravel()
    assert points["C0"] == pytest.approx(com)
    assert (points["C1"] + points["C2"]) / 2 == pytest.approx(com)
    assert np.linalg.norm(points["C1"] - points["C2"]) == pytest.approx(2 * q[3])
    ellipse = ax.patches[0]
    ends = ax.transData.inverted().transform(ellipse.get_transform().transform([[1, 0], [-1, 0]]))
    assert sorted(map(tuple, ends)) == [pytest.approx(x) for x in sorted([tuple(points["C1"]), tuple(points["C2"])])]


def test_ground_reaction_is_that_of_the_plan(material, bhr):
    """CoP and forces from the foot wrenches agree with the planar dynamics."""
    tape = material["tape"]
    r = plotting.ground_reaction(tape, bhr)
    weight = bhr.total_mass * 9.8
    assert r["force"][0, :, 2].sum() == pytest.approx(weight, rel=1e-3)
    assert r["cop_x"][0] == pytest.approx(bhr.sagittal.sole_center[0], abs=1e-3)
    raised = r["heel_z"] > 0.005
    assert raised.any() and np.nanmax(np.abs(r["cop_x"][raised])) < 0.01
    assert np.isnan(r["cop_x"][-1]).all() and np.isnan(r["friction"][-1]).all()


# tables -----------------------------------------------------------------------------------------------------------
def test_table_as_text_and_html():
    rows = [{"name": "<a>", "x": 1.23456, "n": 3, "ok": True}, {"name": "b", "x": float("nan"), "n": None}]
    shown = plotting.table(rows, {"name": "what", "x": "x [m]", "n": "n", "ok": "ok"}, digits=3)
    assert str(shown).splitlines() == [
        "what  x [m]  n  ok",
        "----  -----  -  ---",
        "<a>    1.23  3  yes",
        "b         —",
    ]
    html = shown._repr_html_()
    assert "&lt;a&gt;" in html and html.count("<tr>") == 3 and 'text-align:right">1.23<' in html
    assert str(plotting.table([])) == "\n"
    places = plotting.table([{"x": 1.0, "n": 3}, {"x": -0.0004, "n": None}, {"x": float("inf")}], decimals=3)
    assert [row[0] for row in places.rows] == ["1.000", "0.000", "—"] and places.rows[0][1] == "3"
    buffer = io.StringIO()
    print(plotting.table(iter(rows)), file=buffer)
    assert buffer.getvalue().startswith("name      x  n  ok")
