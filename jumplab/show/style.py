"""Colours, sizes, curves by phase, and saving: what makes two figures look alike.

Figures are :class:`Picture` objects, unknown to pyplot: a notebook shows one when it is the last
expression of a cell (:func:`save_figure` returns it), nothing is shown twice, and nothing has to be
closed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import rc_context, rc_params_from_file, rcParams, rcParamsDefault
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import is_color_like, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jumplab.arguments import shaped
from jumplab.auditing.replay import runs
from jumplab.errors import InputError, quoted
from jumplab.forms import filled
from jumplab.io.folder import versions, write_file
from jumplab.robot import Robot
from jumplab.show.waiting import show_waiting
from jumplab.task import JumpTask

Color = str | tuple[float, float, float]  # as Matplotlib has them
Tasks = JumpTask | Sequence[JumpTask] | None
# Okabe and Ito's palette, which stays apart for every kind of colour vision
LAUNCH, FLIGHT, LANDING = "#0072B2", "#E69F00", "#009E73"
PURPLE, SKY, VERMILION = "#CC79A7", "#56B4E9", "#D55E00"
PHASE_COLORS = {"launch": LAUNCH, "flight": FLIGHT, "landing": LANDING}
INK = "#222222"  # text and outlines
LIMIT, GROUND = "#999999", "#8C8C8C"

# width of one column of an IEEE page, and of both [in]
COLUMN_IN = 3.5
PAGE_IN = 7.16
PAGE_MOST_IN = 100  # more is a typo
DPI = 200  # of the PNG
PNG_METADATA = {"Software": None}  # no versions and no dates: the same figure gives the same bytes
PDF_METADATA = {"Creator": None, "Producer": None, "CreationDate": None}
MIN_FONT_PT = 6.5  # smallest text in any figure; tests look for smaller
REFERENCE_STYLE = {"color": INK, "linestyle": (0, (4, 2)), "linewidth": 0.9}  # what was asked for
LIMIT_STYLE = {"color": LIMIT, "linewidth": 0.7}  # a bound
BAND = (0.928, 0.928, 0.928)  # fill of what is allowed between two bounds
# keywords of Axes.annotate
NOTE_STYLE = {"textcoords": "offset points", "fontsize": 7, "color": "#666666"}
# of the style, in points: they grow with a font.size of the user's
TEXT_SIZES = """axes.labelsize xtick.labelsize ytick.labelsize axes.titlesize
    legend.fontsize""".split()
STYLE_FILE = Path(__file__).with_name("jumplab.mplstyle")


def use_style() -> None:
    """A notebook's second cell: this style is matplotlib's, and cells that take long show a bar."""
    plt.style.use(STYLE_FILE)
    show_waiting()


_TURN = RLock()  # settings are the whole process's, so threads take turns


@contextmanager
def _style(whole: bool) -> Iterator[None]:
    """The style within a block or a function: ``whole`` whatever the caller's settings are, else
    with those that differ from Matplotlib's defaults left as they are.
    """
    with _TURN:
        settings = {} if whole else {k: v for k, v in _ours().items() if v != rcParamsDefault[k]}
        with plt.style.context(STYLE_FILE):
            larger = settings.get("font.size", rcParams["font.size"]) / rcParams["font.size"]
            rcParams.update({key: larger * rcParams[key] for key in TEXT_SIZES} | settings)
            yield


def _ours() -> dict[str, Any]:
    """Values now of the settings that the style has."""
    return {
        key: rcParams[key] for key in rc_params_from_file(STYLE_FILE, use_default_template=False)
    }


styled = _style(whole=True)
themed = _style(whole=False)  # for pictures of results: the user's style wins


class Picture(Figure):
    """A figure that a notebook shows, whatever backend is chosen there, with its caption if it has
    one.
    """

    caption = ""  # and its PNG, see save_figure
    _saved = b""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.settings = _ours()  # under which it is drawn later too

    def png(self) -> bytes:
        """The figure as a PNG."""
        if self._saved and not self.stale:
            return self._saved
        return file_of(self, "png", dpi=self.get_dpi(), metadata=PNG_METADATA)

    @property
    def _repr_png_(self) -> Callable[[], bytes] | None:
        return None if self.caption else self.png  # a notebook keeps one of both

    def _repr_html_(self) -> str | None:
        if not self.caption:
            return None
        return filled("show/picture.html", png=self.png(), caption=self.caption)


def file_of(fig: Figure, kind: str, **options: Any) -> bytes:
    """A figure as a file of that kind ("png", "pdf"); ``options`` of ``Figure.savefig``."""
    buffer = io.BytesIO()
    with _style(whole=True), rc_context(getattr(fig, "settings", {})):
        fig.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


@themed
def new_figure(width: float = COLUMN_IN, height: float = 2.4) -> Picture:
    """An empty figure of the style, ``width`` and ``height`` [in]."""
    if not (0 < width < PAGE_MOST_IN and 0 < height < PAGE_MOST_IN):
        raise InputError(
            f"a figure of {width:g} x {height:g} in: each must be above 0 and below {PAGE_MOST_IN}"
        )
    return Picture(figsize=(width, height))


def tint(color: Color, share: float) -> tuple[float, float, float]:
    """(r, g, b) of ``color`` mixed with white: share 1 is the colour itself, 0 is white."""
    return tuple(1 - share * (1 - x) for x in _mixed(color, share))


def shade(color: Color, share: float) -> tuple[float, float, float]:
    """(r, g, b) of ``color`` mixed with black: share 1 is the colour itself, 0 is black."""
    return tuple(share * x for x in _mixed(color, share))


def _mixed(color: Color, share: float) -> tuple[float, float, float]:
    """(r, g, b) of a color of which there is to be a ``share``."""
    if not is_color_like(color):
        raise InputError(f"color {quoted(color)}: Matplotlib has no such color")
    if not 0 <= share <= 1:
        raise InputError(f"a share of {share:g} of a color is outside 0 ... 1")
    return to_rgb(color)


# curves of a jump
# -----------------------------------------------------------------------------------------------
def by_phase(ax: Axes, t: np.ndarray, y: np.ndarray, phase: np.ndarray, **kwargs) -> list[Line2D]:
    """Plot ``y`` (N,) over ``t`` (N,), each run of one ``phase`` (N,) in that phase's colour.

    ``phase`` holds names of :data:`PHASE_COLORS`; further keywords go to ``Axes.plot``.
    """
    t = shaped(t, (len(phase),), "t")
    y = shaped(y, (len(phase),), "y")
    if unknown := sorted({*map(str, phase)} - {*PHASE_COLORS}):
        raise InputError(f"phase {unknown[0]!r}: must be one of {', '.join(PHASE_COLORS)}")
    lines = []
    for rows in runs(phase):
        look = {"color": PHASE_COLORS[str(phase[rows.start])]} | kwargs
        try:
            lines += ax.plot(t[rows], y[rows], **look)
        except (AttributeError, TypeError, ValueError) as e:
            raise InputError(f"no line can look like {quoted(kwargs)}: {quoted(e)}") from None
    return lines


def compare(
    ax: Axes,
    curve: tuple,
    *references: tuple,
    label: str = "",
    marks: Iterable[float] = (),
    **kwargs,
) -> None:
    """A curve (t, y, phase), references (t, y) dashed, ``marks`` where phases change [s]; all (N,).

    Raises :class:`InputError` for others.
    """
    for given, words in ((curve, "t, y, phase"), *((x, "t, y") for x in references)):
        if len(given) != len(words.split()):
            raise InputError(f"a curve must be ({words}), got {len(given)} values")
    by_phase(ax, *curve, **kwargs)
    for t, y in references:
        ax.plot(t, shaped(y, (len(t),), "y of a reference"), **REFERENCE_STYLE)
    mark_time(ax, marks)
    ax.set_ylabel(label)


def mark_time(ax: Axes, times: Iterable[float]) -> None:
    """Thin dotted vertical lines at the ``times`` [s] where phases change."""
    for t in times:
        ax.axvline(t, color=LIMIT, linewidth=0.6, linestyle=(0, (1, 2)), zorder=0)


def limits(ax: Axes, *bounds: float) -> None:
    """Thin horizontal lines at bounds."""
    for bound in bounds:
        ax.axhline(bound, **LIMIT_STYLE)


def phase_handles(
    *phases: str, reference: str | None = None, limit: str | None = None
) -> list[Line2D]:
    """Legend entries: phases by name, then texts (if any) for dashed reference and thin limits."""
    looks = {phase: {"color": PHASE_COLORS[phase]} for phase in phases}
    looks |= {reference: REFERENCE_STYLE, limit: LIMIT_STYLE}
    return [Line2D([], [], **look, label=text) for text, look in looks.items() if text]


def legend_above(fig: Figure, handles: list[Artist]) -> None:
    """One legend over all panels, outside of them."""
    fig.legend(handles=handles, loc="outside upper center", ncols=len(handles), columnspacing=1.4)


def panel_letters(axes: Iterable[Axes]) -> None:
    """(a), (b), ... before the panels' titles."""
    for letter, ax in zip("abcdefghijklmnop", axes, strict=False):
        ax.set_title(f"({letter}) {ax.get_title(loc='left')}".rstrip())


def bare(ax: Axes) -> None:
    """No frame, ticks or grid: for pictures rather than plots."""
    # hidden ticks would still be laid out, which takes longer than the picture
    ax.set(xticks=[], yticks=[])
    ax.set_axis_off()
    ax.grid(False)


# saving
# ----------------------------------------------------------------------------------------------
def save_figure(
    fig: Figure,
    name: str,
    folder: str | Path,
    caption: str = "",
    *,
    task: Tasks = None,
    robot: Robot | None = None,
) -> Figure:
    """Write NAME.png, NAME.pdf and NAME.txt (caption, target or targets, robot, versions) into
    ``folder``.

    A notebook shows the caption below the figure. The same figure gives the same bytes: the files
    carry neither dates nor versions of the software that wrote them. It is laid out once, for the
    PNG; the PDF and what a notebook shows keep that layout. Returns the figure. Raises
    :class:`InputError` if ``name`` is not a plain file name, or the folder cannot be written.
    """
    if not name or Path(name).name != name or name.startswith("."):
        raise InputError(
            f"figure name {name!r}: must be a plain file name without ending, such as 'f08_joints'"
        )
    png = file_of(fig, "png", dpi=DPI, metadata=PNG_METADATA)
    fig.set_layout_engine("none")
    pdf = file_of(fig, "pdf", metadata=PDF_METADATA)
    fig.caption = caption.strip()
    fig._saved = png  # a notebook shows it without drawing it again ...
    fig.stale = False  # ... until it is changed
    text = caption_text(caption, task, robot).encode()
    for ending, content in (("png", png), ("pdf", pdf), ("txt", text)):
        write_file(Path(folder, f"{name}.{ending}"), content)
    return fig


def made_with() -> str:
    """The installed packages that shape a result, with their versions."""
    return ", ".join(
        f"{name} {number}" for name, number in versions().items() if number != "not installed"
    )


def caption_text(caption: str, task: Tasks = None, robot: Robot | None = None) -> str:
    """Text of NAME.txt: caption, target (or targets), robot and versions, one line each."""
    tasks = [task] if isinstance(task, JumpTask) else task or ()
    return filled(
        "show/caption.txt",
        caption=caption.strip(),
        tasks=[*map(describe_task, tasks)],
        robot=robot,
        made_with=made_with(),
    )


def describe_task(task: JumpTask) -> str:
    """The target in words, such as "1.00 m forward, CoM rise 0.50 m"."""
    way = "forward" if task.distance_m >= 0 else "backward"
    side = "left" if task.side_m > 0 else "right"
    level = "higher" if task.platform_m > 0 else "lower"
    words = {
        f"{abs(task.distance_m):.2f} m {way}": True,
        f"{abs(task.side_m):.2f} m to the {side}": task.side_m,
        f"CoM rise {task.height_m:.2f} m": True,
        f"turn {np.degrees(task.yaw_rad):.0f} deg": task.yaw_rad,
        f"landing {abs(task.platform_m):.2f} m {level}": task.platform_m,
        f"rotation {np.degrees(task.rotation_rad):.0f} deg": task.rotation_rad,
        f"run-up of {task.run_up} step{'s' * (task.run_up > 1)}": task.run_up,
        f"take-off from the {task.takeoff} foot": task.takeoff != "both",
        f"landing on the {task.landing} foot": task.landing != "both",
    }
    return ", ".join(text for text, said in words.items() if said)
