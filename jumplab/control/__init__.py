"""The robot's controllers, which know no simulator: from measured states to joint torques. Of
their numbers the paper prints the cycle alone.

Names are loaded when they are first used.
"""

import lazy_loader as lazy

STEP_S = 0.001  # [s] the paper's control cycle (Sec. VI-A)
STAND_S = 3.0  # standing this long after touchdown, and not a moment less, is a landing

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["kinematics", "playback", "reaim", "servo"],
    submod_attrs={
        "controller": ["Controller", "Hardware"],
        "estimator": ["Estimator", "SensorNoise"],
        "landing": ["LandingController", "LandingGains"],
    },
)
