"""A humanoid robot jumps: planned by three chained optimisations, audited, simulated, and drawn."""
