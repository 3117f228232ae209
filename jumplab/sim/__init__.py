"""Simulation: in come a tape and a robot, out comes a :class:`SimulationResult`. Start at :func:`simulate_jump`.

Names are loaded when they are first used: a scene or a perturbation needs no engine.
"""

from importlib import import_module
from typing import Any

STEP_S = 0.001  # [s] of the simulation, the paper's control cycle (Sec. VI-A)
# name -> (module here, class, what to install); the first is the default
ENGINES = {
    "bullet": ("bullet", "BulletEngine", "pybullet"),
    "mujoco": ("mujoco", "MujocoEngine", "mujoco"),
}
DEFAULT_ENGINE = next(iter(ENGINES))

_PLACES = {
    "bullet": "BulletEngine base_from_bullet base_to_bullet",
    "engine": "Engine engine_class",
    "estimator": "Estimator",
    "landing": "LandingController LandingGains",
    "loop": "Disturbance simulate_jump simulate_landing",
    "mujoco": "MujocoEngine",
    "perturbation": "SLIGHT Perturbation Ranges SensorNoise",
    "reference": "LandingReference",
    "result": "Finding Metrics SimulationResult",
    "scene": "Block Scene",
}
_MODULE_OF = {name: module for module, names in _PLACES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    return value
