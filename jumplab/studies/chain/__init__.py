"""Chained jumps, each planned from what is measured while the robot flies or lands. Start at
:func:`run_chain`.
"""

from jumplab.studies.chain.course import Course as Course
from jumplab.studies.chain.course import crouched as crouched
from jumplab.studies.chain.foresight import rehearse as rehearse
from jumplab.studies.chain.result import ChainResult as ChainResult
from jumplab.studies.chain.result import write_chain as write_chain
from jumplab.studies.chain.run import run_chain as run_chain
from jumplab.studies.chain.series import RANGES as RANGES
from jumplab.studies.chain.series import run_chains as run_chains
