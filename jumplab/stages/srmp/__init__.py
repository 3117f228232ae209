"""Stage 1: momentum, inertia and CoP trajectories of the reaction mass pendulum (Sec. III of the
paper).

In: a target. Out: a :class:`SrmpPlan` of launch and flight, one nonlinear program joined at
take-off, because nothing printed ties the launch's final angular momentum to the rotation that the
flight needs. Begin with :mod:`problem`.
"""

from jumplab.stages.srmp.landing import LandingPlanner
from jumplab.stages.srmp.planner import SrmpPlan, SrmpPlanner, naive_guess, parameters
from jumplab.stages.srmp.problem import build_problem
from jumplab.stages.srmp.settings import SrmpSettings

__all__ = [
    "LandingPlanner",
    "SrmpPlan",
    "SrmpPlanner",
    "SrmpSettings",
    "build_problem",
    "naive_guess",
    "parameters",
]
