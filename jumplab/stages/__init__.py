"""The three steps of the plan, each with its own model, and the planner that chains them."""
