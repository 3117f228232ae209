"""How long planning takes: measured against one direct NLP, and said as it is."""

from jumplab.benchmark.measure import bench
from jumplab.benchmark.report import APPROACHED, DIRECT, GOALS, WORDS, text

__all__ = ["APPROACHED", "DIRECT", "GOALS", "WORDS", "bench", "text"]
