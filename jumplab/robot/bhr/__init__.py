"""The default robot: its numbers, its URDF, and the roles of its joints."""
