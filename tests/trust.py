"""Trust in jumplab, in numbers: drawn wrong calls, damaged folders, signals, kills, threads.

``python tests/trust.py KIND DIR [N]`` does the first N cases of a kind (one of :data:`KINDS`, with its usual N), keeps
each in DIR/KIND.jsonl, goes on there after a stop, and prints the counts and every fault. No part of the collected
tests, which take a few cases of each kind (``test_shots.py``, ``test_trust.py``).
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from damage import calls, folders
from shots import kills, signals
from together import together

from jumplab.io.files import open_log
from jumplab.studies.study import code

# does case number k, drawn by a generator, and returns its row; "fault" is empty if there is none
Case = Callable[[int, random.Random], dict[str, Any]]
# name -> (what makes the cases, given a folder to work in; usual number of cases)
KINDS: dict[str, tuple[Callable[[Path], Case], int]] = {
    "calls": (calls, 5000),
    "folders": (folders, 200),
    "signals": (signals, 300),
    "kills": (kills, 100),
    "together": (together, 10),
}


def measure(kind: str, folder: Path, count: int | None = None) -> int:
    """Do the cases of a kind that the folder's log does not have; returns the number of faults."""
    make, usual = KINDS[kind]
    folder.mkdir(parents=True, exist_ok=True)
    with open_log(folder / f"{kind}.jsonl", "study", lambda row: (row["number"], row)) as log:
        missing = [k for k in range(count or usual) if k not in log.done]
        case = make(folder) if missing else None
        for k in missing:
            row = {"number": k, "code": code()} | case(k, random.Random(f"{kind} {k}"))
            log.add(row)
            log.done[k] = row
        rows = [log.done[k] for k in range(count or usual)]
    faults = [row for row in rows if row["fault"]]
    for row in faults:
        print(row)
    ends = ", ".join(f"{n} {name}" for name, n in sorted(Counter(row["end"] for row in rows).items()))
    print(f"{kind}: {len(rows)} cases, {len(faults)} faults, by {len({r['code'] for r in rows})} version(s); {ends}")
    return len(faults)


if __name__ == "__main__":
    sys.exit(min(1, measure(sys.argv[1], Path(sys.argv[2]).resolve(), *map(int, sys.argv[3:]))))
