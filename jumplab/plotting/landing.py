"""Stage 1's landing in pictures: from touchdown to standing."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from jumplab.plotting.style import LANDING, LIMIT_STYLE, PAGE_IN, REFERENCE_STYLE, new_figure, styled, tint
from jumplab.robot.reach import Reach
from jumplab.srmp.landing import LandingPlan
from jumplab.task import GRAVITY


@styled
def landing_reference(plan: LandingPlan, reach: Reach) -> Figure:
    """CoM, angular momentum, ground force and CoP from touchdown until the robot stands, and the stance dashed."""
    fig = new_figure(PAGE_IN, 2.9)
    axes = fig.subplots(2, 2, sharex=True)
    length, weight = float(reach.start[1]), reach.mass * GRAVITY
    heel, toe = reach.cop
    axes[0, 0].plot(plan.t, plan.com[:, 1], color=LANDING)
    axes[0, 0].axhline(length, **REFERENCE_STYLE)
    axes[0, 0].set_ylabel("CoM height [m]")
    axes[0, 1].plot(plan.t, plan.F_z / weight, color=LANDING)
    axes[0, 1].axhline(1.0, **REFERENCE_STYLE)
    axes[0, 1].set_ylabel("$F_z$ [body weights]")
    axes[1, 0].plot(plan.t, plan.L, color=LANDING)
    axes[1, 0].axhline(0.0, **REFERENCE_STYLE)
    axes[1, 0].set_ylabel("$L$ [kg m$^2$/s]")
    ax = axes[1, 1]
    ax.fill_between(plan.t, 100 * heel, 100 * toe, color=tint("#999999", 0.18), linewidth=0)
    for bound in (heel, toe):
        ax.axhline(100 * bound, **LIMIT_STYLE)
    ax.plot(plan.t, 100 * plan.cop_x, color=LANDING, label="CoP")
    ax.plot(plan.t, 100 * plan.com[:, 0], color=LANDING, linewidth=0.9, linestyle=(0, (1, 1.2)), label="CoM")
    ax.set_ylabel("from mid-sole [cm]")
    reach_cm = 100 * max(abs(heel), abs(toe), float(np.abs(plan.com[:, 0]).max()))
    ax.set_ylim(-1.15 * reach_cm, 1.15 * reach_cm)
    ax.legend(loc="lower right", ncols=2)
    for ax in axes[1]:
        ax.set_xlabel("time since touchdown [s]")
    fig.align_ylabels()
    return fig
