"""From any humanoid's URDF or MJCF to the pair of texts, URDF and TOML, that a jumping robot is
made of. In comes a file, with a configuration or without (:mod:`.roles` writes a first one), out
goes a :class:`.checkup.Checkup` with the robot. Start reading at :func:`.checkup.examine`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(__name__, submodules=["checkup", "roles"])
