"""The three steps of the plan, each with its own model, and the planner that chains them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["joint_qp", "plan", "planner", "reconstruction", "spatial", "srmp", "whole_body"],
    submod_attrs={
        "plan": ["JumpPlan", "StageRow"],
        "planner": ["Planner", "guess_from_joints", "make_tape", "to_link_angles"],
        "reconstruction": ["expand", "planar_quantities"],
    },
)
