"""Pictures of robots, plans and simulations.

Every figure function takes results, draws, and returns a matplotlib figure; none solves, prints or shows. Colours are
launch blue, flight orange, landing green; the reference is dashed, a limit thin and grey.

>>> from jumplab import plotting
>>> plotting.use_style()
>>> fig = plotting.joint_trajectories(tape, robot)
>>> plotting.save_figure(fig, "f08_joint_trajectories", "figures", "Joints of the plan.", task=task, robot=robot)

New figures: :func:`new_figure` (``COLUMN_IN`` or ``PAGE_IN`` wide), :func:`by_phase` for curves, :class:`Silhouette`
with :func:`draw_robot`, :func:`strobe`, :func:`film_strip` for bodies, :func:`draw_srmp` for the pendulum,
:func:`legend_above` with :func:`phase_handles`; decorate the function with :func:`styled`. Small tables: :func:`table`.
"""

from jumplab.show.bodies import (
    Silhouette,
    draw_five_link,
    draw_ground,
    draw_robot,
    draw_srmp,
    equal_scales,
    film_strip,
    five_link_points,
    strobe,
)
from jumplab.show.limits import contact_comparison, ground_reaction, margins
from jumplab.show.simulation import jump_strobe, momentum
from jumplab.show.stages import draw_flight, inertia_and_momentum, joint_trajectories, snapshots
from jumplab.show.style import (
    COLUMN_IN,
    FLIGHT,
    INK,
    LANDING,
    LAUNCH,
    LIMIT_STYLE,
    PAGE_IN,
    PHASE_COLORS,
    PURPLE,
    REFERENCE_STYLE,
    SKY,
    VERMILION,
    bare,
    by_phase,
    describe_task,
    legend_above,
    mark_time,
    new_figure,
    panel_letters,
    phase_handles,
    save_figure,
    shade,
    styled,
    tint,
    use_style,
)
from jumplab.show.tables import Table, table

__all__ = [
    "COLUMN_IN",
    "FLIGHT",
    "INK",
    "LANDING",
    "LAUNCH",
    "LIMIT_STYLE",
    "PAGE_IN",
    "PHASE_COLORS",
    "PURPLE",
    "REFERENCE_STYLE",
    "SKY",
    "VERMILION",
    "Silhouette",
    "Table",
    "bare",
    "by_phase",
    "contact_comparison",
    "describe_task",
    "draw_five_link",
    "draw_flight",
    "draw_ground",
    "draw_robot",
    "draw_srmp",
    "equal_scales",
    "film_strip",
    "five_link_points",
    "ground_reaction",
    "inertia_and_momentum",
    "joint_trajectories",
    "jump_strobe",
    "legend_above",
    "margins",
    "mark_time",
    "momentum",
    "new_figure",
    "panel_letters",
    "phase_handles",
    "save_figure",
    "shade",
    "snapshots",
    "strobe",
    "styled",
    "table",
    "tint",
    "use_style",
]
