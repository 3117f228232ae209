"""An optimal-control solver that knows nothing of robots.

In: a :class:`Problem` (phases, terms, bounds), and per target its parameters and a
:class:`PhaseGuess` of every phase. Out: a :class:`Solution`, or a
:class:`~jumplab.errors.SolverError` that names the terms in conflict. Start reading in
:mod:`jumplab.ocp.problem`; then ``derivatives.py`` makes small functions of it, ``assembly.py``
one sparse program, ``posing.py`` puts numbers in, ``nlp.py`` solves it.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submod_attrs={
        "changes": ["changed"],
        "nlp": ["Nlp"],
        "problem": ["Bound", "Phase", "Point", "Problem", "Term"],
        "solution": ["PhaseGuess", "PhaseSolution", "Solution", "Statistics"],
    },
)
