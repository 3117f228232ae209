"""From any humanoid's URDF to the pair of texts, URDF and TOML, that a jumping robot is made of.

In comes a URDF with a configuration (:mod:`.roles` writes a first one), out goes a :class:`.jumper.Jumper`. Start
reading at :func:`.jumper.make_jumper`.
"""
