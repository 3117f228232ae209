"""How long planning takes: measured against one direct NLP, and said as it is."""

from jumplab.benchmark.measure import bench
from jumplab.benchmark.report import GOALS, text

__all__ = ["GOALS", "bench", "text"]
