"""An optimal-control solver that knows nothing of robots.

In: a :class:`Problem` (phases, terms, bounds), and per target its parameters and a :class:`PhaseGuess` of every phase.
Out: a :class:`Solution`, or a :class:`~jumplab.errors.SolverError` that names the terms in conflict.
Start reading in :mod:`jumplab.ocp.problem`; then ``nlp.py``, which solves what ``assembly.py`` makes of it.
"""

from jumplab.ocp.changes import changed
from jumplab.ocp.nlp import Nlp
from jumplab.ocp.problem import Bound, Phase, Point, Problem, Term
from jumplab.ocp.solution import Near, PhaseGuess, PhaseSolution, Solution, Statistics

__all__ = [
    "Bound",
    "Near",
    "Nlp",
    "Phase",
    "PhaseGuess",
    "PhaseSolution",
    "Point",
    "Problem",
    "Solution",
    "Statistics",
    "Term",
    "changed",
]
