"""Stage 3 and the direct planner: the whole-body program, one jump of any tree of joints along any
contact schedule.

Coordinates are the base's place and attitude and all joints (``coordinates.py``: or those of an
even or a planar motion); a :class:`Contacts` says which foot carries when. Legs that carry follow
from their foot's place on three levels, in flight the base follows from the CoM's parabola and L.
Forces act at the soles' corners along the edges of their friction pyramids: friction, CoP and yaw
torque are bounds. The tape between the nodes is exact (``tape.py``). Term names carry the paper's
equations; what the paper leaves out is marked "ours". Start reading in ``contacts.py``;
``mode.py`` has the numbers of a phase, ``instant.py`` what terms see, ``terms.py`` the terms, and
``problem.py`` puts the phases together.
"""

from jumplab.stages.whole_body.contacts import ContactPhase, Contacts, Place
from jumplab.stages.whole_body.plan import WholeBodyPlan
from jumplab.stages.whole_body.planner import WholeBodyPlanner
from jumplab.stages.whole_body.settings import Limits, Mesh, Weights

__all__ = [
    "ContactPhase",
    "Contacts",
    "Limits",
    "Mesh",
    "Place",
    "Weights",
    "WholeBodyPlan",
    "WholeBodyPlanner",
]
