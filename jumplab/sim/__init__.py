"""Simulation: in come a tape and a robot, out comes a :class:`SimulationResult`. Start at :func:`simulate_jump`.

Names are loaded when they are first used: a scene or a perturbation needs no engine.
"""

import lazy_loader as lazy

STEP_S = 0.001  # [s] of the simulation, the paper's control cycle (Sec. VI-A)

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["checks", "kinematics", "pilot", "playback", "reaim"],
    submod_attrs={
        "estimator": ["Estimator"],
        "landing": ["LandingController", "LandingGains"],
        "loop": ["Disturbance", "simulate_jump", "simulate_landing"],
        "perturbation": ["SLIGHT", "Perturbation", "Ranges", "SensorNoise"],
        "reference": ["LandingReference"],
        "result": ["Finding", "Metrics", "SimulationResult"],
        "scene": ["Block", "Scene"],
        "world": ["World", "base_from_bullet", "base_to_bullet"],
    },
)
