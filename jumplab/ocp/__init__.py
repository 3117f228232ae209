"""An optimal-control solver that knows nothing of robots: words of a problem, its sparse NLP, SQP steps, ipopt."""
