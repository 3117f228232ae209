"""Many plans or many simulations: trials, landing basin, chains, sweeps, envelopes, benchmark.

In come a robot, targets and a result folder; out go frozen reports and a log, with which a stopped study goes on. Start
at :func:`jumplab.studies.trials.run_trials`.
"""
