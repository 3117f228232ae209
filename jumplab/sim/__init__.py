"""Simulation in PyBullet: playback of a tape, landing, and what came of it. Start at :func:`simulate_jump`."""

from jumplab.sim.checks import Finding
from jumplab.sim.estimator import Estimator
from jumplab.sim.landing import LandingController, LandingGains
from jumplab.sim.loop import Disturbance, simulate_jump, simulate_landing
from jumplab.sim.perturbation import SLIGHT, Perturbation, Ranges, SensorNoise
from jumplab.sim.reference import LandingReference
from jumplab.sim.result import Metrics, SimulationResult
from jumplab.sim.scene import Block, Scene
from jumplab.sim.world import World, base_from_bullet, base_to_bullet

__all__ = [
    "SLIGHT",
    "Block",
    "Disturbance",
    "Estimator",
    "Finding",
    "LandingController",
    "LandingGains",
    "LandingReference",
    "Metrics",
    "Perturbation",
    "Ranges",
    "Scene",
    "SensorNoise",
    "SimulationResult",
    "World",
    "base_from_bullet",
    "base_to_bullet",
    "simulate_jump",
    "simulate_landing",
]
