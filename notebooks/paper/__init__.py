"""Code that only the reproduction of the paper needs: its forms as printed, its claims, and one-off figures."""
