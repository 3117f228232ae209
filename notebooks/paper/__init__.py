"""Code of the notebooks and of commands that plan nothing: their runner, forms as printed, claims, studies, figures."""
