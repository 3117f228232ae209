"""Simulation in PyBullet: playback of a tape, landing, and what came of it. Start at :func:`simulate_jump`."""

from jumplab.simulation.estimator import Estimator
from jumplab.simulation.honesty import Finding
from jumplab.simulation.jump import Disturbance, simulate_jump, simulate_landing
from jumplab.simulation.landing import LandingController, LandingGains
from jumplab.simulation.perturbation import SLIGHT, Perturbation, Ranges, SensorNoise
from jumplab.simulation.reference import LandingReference
from jumplab.simulation.result import Metrics, SimulationResult
from jumplab.simulation.scene import Block, Scene
from jumplab.simulation.world import World, base_from_bullet, base_to_bullet

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
