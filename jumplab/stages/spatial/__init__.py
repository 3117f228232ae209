"""Jumps in three dimensions: one program for the whole robot, of any tree of joints, in the words of stage 3.

Coordinates are the base's place and attitude and all joints; feet in their places are rows on positions at the nodes.
Forces act at the soles' corners along the edges of their friction cones: friction, CoP and yaw torque are bounds. In
flight the base's place follows from the CoM's parabola, and L stays in all three components. The tape between the
nodes is exact (``tape.py``). It begins with stage 2's motion, or with a jump ahead and ramps (``start.py``). Start
reading in ``terms.py``.
"""

from jumplab.stages.spatial.planner import SpatialPlan, SpatialPlanner
from jumplab.stages.spatial.problem import build_problem
from jumplab.stages.spatial.settings import SpatialLimits, SpatialWeights

__all__ = ["SpatialLimits", "SpatialPlan", "SpatialPlanner", "SpatialWeights", "build_problem"]
