"""Many plans or many simulations: trials, chains, sweeps, maps, atlases.

In come a robot, targets and a result folder; out go frozen reports and a log, with which a stopped
study goes on. A study makes cases, each with a key of all that decides it, and
:mod:`jumplab.studies.study` does those that the log lacks. Start at
:func:`jumplab.studies.trials.run_trials`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=[
        "atlas",
        "chain",
        "envelope",
        "grid",
        "record",
        "study",
        "sweep",
        "trials",
    ],
)
