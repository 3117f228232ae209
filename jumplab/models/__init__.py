"""Models of the robot for the stages, each a source of named quantities at one instant.

In: states and their rates. Out: momentum, inertia, forces, torques, and for the nine links their
Jacobians. Start reading in :mod:`jumplab.models.srmp` (stage 1); then ``full.py`` (stage 2) and
``spatial.py`` (stage 3 and the direct planner).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(__name__, submodules=["full", "spatial", "srmp"])
