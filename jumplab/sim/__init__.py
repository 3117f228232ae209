"""Simulation: in come a tape and a robot, out comes a :class:`SimulationResult`. Start at
:func:`simulate_jump`.

Names are loaded when they are first used: a scene or a perturbation needs no engine.
"""

from importlib.util import find_spec

import lazy_loader as lazy

from jumplab.control import STEP_S as STEP_S  # of the simulation too

# name -> (module here, class, package it imports, how to get that)
ENGINES = {
    "bullet": (
        *("bullet", "BulletEngine", "pybullet"),
        "pip install pybullet on Python 3.11, pybullet-arm64 on 3.12 and 3.13 "
        "(it is built for no later one)",
    ),
    "mujoco": ("mujoco", "MujocoEngine", "mujoco", "pip install mujoco"),
}
INSTALLED = tuple(name for name, (_, _, package, _) in ENGINES.items() if find_spec(package))
# how contacts give way: as little as the engine can, which a plan assumes; or with the engine's own
# defaults, as most people simulate
CONTACTS = ("hard", "usual")
# the first that is installed: PyBullet, or MuJoCo where that is not there
DEFAULT_ENGINE = (*INSTALLED, *ENGINES)[0]

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["checks"],
    submod_attrs={
        "causes": ["Sign", "signs"],
        "bullet": ["BulletEngine", "base_to_bullet"],
        "engine": ["Engine", "engine_class"],
        "loop": ["Disturbance", "simulate_jump"],
        "mujoco": ["MujocoEngine"],
        "perturbation": [
            "SLIGHT",
            "Perturbation",
            "Ranges",
            "SensorNoise",
            "Shove",
            "is_pair",
            "ranges_of",
        ],
        "result": ["Finding", "Metrics", "SimulationResult"],
        "scene": ["Block", "Scene"],
    },
)
