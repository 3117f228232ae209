"""The whole-body program: one jump of any tree of joints along any contact schedule.

Coordinates are the base's place and attitude and all joints; a :class:`Contacts` says which foot carries when. Legs
that carry follow from their foot's place on three levels, in flight the base follows from the CoM's parabola and L.
Forces act at the soles' corners along the edges of their friction pyramids: friction, CoP and yaw torque are bounds.
The tape between the nodes is exact (``tape.py``). Start reading in ``contacts.py``, then ``terms.py``.
"""

from jumplab.stages.spatial.contacts import ContactPhase, Contacts, Place
from jumplab.stages.spatial.planner import SpatialPlan, SpatialPlanner
from jumplab.stages.spatial.settings import SpatialLimits, SpatialWeights

__all__ = ["ContactPhase", "Contacts", "Place", "SpatialLimits", "SpatialPlan", "SpatialPlanner", "SpatialWeights"]
