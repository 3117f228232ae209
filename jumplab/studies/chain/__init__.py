"""Chained jumps, each planned from what is measured while the robot flies or lands. Start at :func:`run_chain`."""

from jumplab.studies.chain.course import Course, crouched
from jumplab.studies.chain.foresight import Ahead, Rehearsal
from jumplab.studies.chain.result import ChainedJump, ChainResult, write_chain
from jumplab.studies.chain.simulation import run_chain
from jumplab.studies.chain.trials import RANGES, ChainReport, ChainTrial, run_chains

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
