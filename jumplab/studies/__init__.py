"""Many plans or many simulations: trials, landing basin, certificates, chains, sweeps, envelopes, benchmark.

In come a robot, targets and a result folder; out go frozen reports and a log, with which a stopped study goes on. Start
at :func:`jumplab.studies.trials.run_trials`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__,
    submodules=["atlas", "basin", "bench", "certify", "chain", "clips", "envelope", "margins", "sweep", "trials"],
)
