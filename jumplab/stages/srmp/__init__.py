"""Stage 1: momentum, inertia and CoP trajectories of the reaction mass pendulum (Sec. III of the paper).

Launch and flight are one nonlinear program joined at take-off, because nothing in the printed launch problem ties its
final angular momentum to the rotation that the flight needs. Every term carries the paper's equation or says that it is
ours.
"""

from jumplab.stages.srmp.planner import (
    SrmpFlight,
    SrmpLaunch,
    SrmpPlan,
    SrmpPlanner,
    naive_guess,
    parameters,
    sample_plan,
)
from jumplab.stages.srmp.problem import SYMMETRY_OFF, build_problem
from jumplab.stages.srmp.settings import SrmpSettings

__all__ = ["SYMMETRY_OFF", "SrmpFlight", "SrmpLaunch", "SrmpPlan", "SrmpPlanner", "SrmpSettings", "build_problem",
           "naive_guess", "parameters", "sample_plan"]  # fmt: skip
