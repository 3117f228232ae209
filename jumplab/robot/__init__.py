"""A robot is data: a URDF, the roles of its joints, its soles and its standing posture.

In: a shipped name, a TOML or a URDF. Out: an immutable :class:`Robot` and its
:class:`SagittalModel` of five links. Begin with :mod:`description`; stage 1's view of what the
robot can do is in :mod:`reach`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["contact", "description", "files", "legs", "motors", "reach", "sagittal", "stance"],
    submod_attrs={
        "description": ["Robot"],
        "files": ["SHIPPED"],
        "reach": ["postures"],
        "sagittal": ["JOINT_OF_ANGLES", "SAGITTAL_JOINTS", "SAGITTAL_LINKS", "SagittalModel"],
        "stance": ["configuration"],
    },
)
