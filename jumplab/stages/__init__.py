"""The three steps of the plan, each with its own model, and the planner that chains them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["joint_qp", "plan", "planner", "reconstruction", "srmp", "whole_body"],
    submod_attrs={
        "plan": ["JumpPlan", "StageRow", "make_tape"],
        "planner": ["Planner", "motion_of_joints"],
        "reconstruction": ["planar_columns", "to_link_angles"],
    },
)
