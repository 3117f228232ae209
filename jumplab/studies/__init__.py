"""Many plans or many simulations: trials, chains, sweeps, envelopes, benchmark."""
