"""Pictures, tables and the 3-D page of robots, plans, simulations and studies.

Every figure function takes results, draws, and returns a matplotlib figure; none solves, prints or
shows. Colours are launch blue, flight orange, landing green; the reference is dashed, a limit thin
and grey.

>>> jl.plots.use_style()  # once per notebook, for plots of your own
>>> fig = jl.plots.joint_trajectories(plan.tape, robot)
>>> jl.plots.save_figure(fig, "joints", "figures", "Joints.", task=plan.task, robot=robot)

These figures keep settings of Matplotlib that you changed, as by ``plt.style.use("ggplot")``. A new
figure is a function under :func:`themed` (or :func:`styled`, which keeps none) that begins with
:func:`new_figure` (``COLUMN_IN`` or ``PAGE_IN`` wide) and returns it. :func:`by_phase` draws
curves, :func:`compare` curves over what was asked for; :class:`Silhouette` with :func:`draw_robot`,
:func:`strobe` or :func:`film_strip` draws bodies; :func:`legend_above` takes :func:`phase_handles`.
The 3-D page is :func:`page`; tables are :func:`table`.
"""

import inspect
from typing import Any

import lazy_loader as lazy

_NAMES = {  # module: its public names, loaded when they are first used
    # for plans, for simulations, and the map of what a robot can do
    "jumps": """joint_trajectories inertia_and_momentum margins active ground_reaction jump_strobe
        momentum""",
    "maps": "envelope_map",
    # the jump in 3-D, tables
    "viewer": "Page page",
    "movies": "Movie movie",
    "tables": "Table table versions",
    "cards": "card clip_sheet price_bars Plots",
    # helpers: bodies, with the sheet of a robot; curves, colours and saving
    "bodies": """robot_sheet Silhouette draw_robot strobe film_strip draw_five_link five_link_points
        draw_ground draw_path draw_com equal_scales""",
    "style": """use_style styled themed new_figure save_figure by_phase compare mark_time limits
        phase_handles legend_above panel_letters bare tint shade describe_task COLUMN_IN PAGE_IN
        PHASE_COLORS LAUNCH FLIGHT LANDING PURPLE SKY VERMILION INK LIMIT_STYLE REFERENCE_STYLE
        MIN_FONT_PT""",
}
_load, __dir__, __all__ = lazy.attach(
    __name__, submod_attrs={module: names.split() for module, names in _NAMES.items()}
)


def __getattr__(name: str) -> Any:
    from jumplab.arguments import checked  # not before something is drawn

    value = _load(name)
    if inspect.isfunction(value):  # whoever comes by this door is told what does not fit
        value = globals()[name] = checked(value)
    return value
