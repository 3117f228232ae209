"""Simulation: in come a tape and a robot, out comes a :class:`SimulationResult`. Start at :func:`simulate_jump`.

Names are loaded when they are first used: a scene or a perturbation needs no engine.
"""

import lazy_loader as lazy

STEP_S = 0.001  # [s] of the simulation, the paper's control cycle (Sec. VI-A)
# name -> (module here, class, what to install); the first is the default
ENGINES = {
    "bullet": ("bullet", "BulletEngine", "pybullet"),
    "mujoco": ("mujoco", "MujocoEngine", "mujoco"),
}
DEFAULT_ENGINE = next(iter(ENGINES))

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["checks", "kinematics", "pilot", "playback", "reaim", "servo"],
    submod_attrs={
        "bullet": ["BulletEngine", "base_from_bullet", "base_to_bullet"],
        "engine": ["Engine", "engine_class"],
        "estimator": ["Estimator"],
        "landing": ["LandingController", "LandingGains"],
        "loop": ["Disturbance", "simulate_jump", "simulate_landing"],
        "mujoco": ["MujocoEngine"],
        "perturbation": ["SLIGHT", "Perturbation", "Ranges", "SensorNoise"],
        "reference": ["LandingReference"],
        "result": ["Finding", "Metrics", "SimulationResult"],
        "scene": ["Block", "Scene"],
    },
)
