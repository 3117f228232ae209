"""From any humanoid's URDF to the pair of texts, URDF and TOML, that a jumping robot is made of."""
