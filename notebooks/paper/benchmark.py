"""What a benchmark's numbers should reach, in words and limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# name in the report of jumplab.studies.bench -> (words, limit, aim); ratios of CPU times
GOALS = {
    "warm_over_direct": ("three steps, warm / direct NLP's solve", 0.6, 0.25),
    "replan_over_direct": ("re-plan of a neighbouring target / direct NLP's solve", 0.3, 0.1),
    "cold_over_direct": ("new process to finished plan / direct NLP's build and solve", 1.5, None),
    "peak_memory_gib": ("peak memory of a new process [GiB]", 1.0, None),
    "node_growth_error": ("cost of an iteration: largest distance from a straight line over the nodes", 0.2, None),
}


def goals(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row per goal for a table: the number in words, its value, limit and aim, and whether it is reached."""
    rows = []
    for name, (words, limit, aim) in GOALS.items():
        value = found[name]
        verdict = "not measured here" if value is None else "reached" if value <= limit else "not reached"
        rows.append({"number": words, "value": value, "limit": limit, "aim": aim, "verdict": verdict})
    return rows
