"""Chained jumps, each planned from what is measured while the robot flies or lands. Start at :func:`run_chain`."""

from jumplab.chains.course import Course
from jumplab.chains.folder import write_chain
from jumplab.chains.foresight import Ahead, Rehearsal
from jumplab.chains.posture import crouched
from jumplab.chains.result import ChainedJump, ChainResult
from jumplab.chains.simulation import run_chain
from jumplab.chains.trials import RANGES, ChainReport, ChainTrial, run_chains

__all__ = [
    "RANGES",
    "Ahead",
    "ChainReport",
    "ChainResult",
    "ChainTrial",
    "ChainedJump",
    "Course",
    "Rehearsal",
    "crouched",
    "run_chain",
    "run_chains",
    "write_chain",
]
