"""What one does with a simulation: correct the goal, let many robots try, read their sensors."""

from jumplab.experiments.basin import BasinGrid, BasinReport, BasinState, landing_basin, states_kept
from jumplab.experiments.goal_bias import BiasedJump, GoalBias, reach_goal
from jumplab.experiments.measurement import Measurement, measure
from jumplab.experiments.monte_carlo import TrialReport, run_trials, simulate_many, wilson
from jumplab.experiments.outcome import outcomes
from jumplab.experiments.trial import Trial, TrialKey, TrialSettings

__all__ = [
    "BasinGrid",
    "BasinReport",
    "BasinState",
    "BiasedJump",
    "GoalBias",
    "Measurement",
    "Trial",
    "TrialKey",
    "TrialReport",
    "TrialSettings",
    "landing_basin",
    "measure",
    "outcomes",
    "reach_goal",
    "run_trials",
    "simulate_many",
    "states_kept",
    "wilson",
]
