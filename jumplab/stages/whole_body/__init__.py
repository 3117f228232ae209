"""Stage 3: whole-body launch and flight of the five-link robot (Sec. V of the paper), and the direct planner.

Coordinates are the absolute angles of foot, shank, thigh, trunk and arm, rooted at the toe: in launch the toe is the
origin, so contact needs no equation; in flight the CoM is the parabola and the toe follows from it, so only dL/dt = 0
remains. Term names carry the paper's equations; what the paper leaves out is marked "ours".
"""

from jumplab.stages.whole_body.flips import FlipPlanner
from jumplab.stages.whole_body.planner import WholeBodyPlan, WholeBodyPlanner
from jumplab.stages.whole_body.problem import build_problem
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights

__all__ = ["FlipPlanner", "Limits", "Mesh", "Weights", "WholeBodyPlan", "WholeBodyPlanner", "build_problem"]
