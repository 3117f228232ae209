"""Code of the notebooks and of commands that are no part of planning: their runner, forms as printed, claims, studies, figures."""
