"""How the audit looks at a tape, and what it allows: the limits of all checks stand in ``limits.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from jumplab.auditing.report import Check


@dataclass(frozen=True)
class Method:
    """Numbers of the audit that are no limits; the paper prints none of them."""

    min_samples: int = 10  # per phase: fewer are no motion
    mid_flight: tuple[float, float] = (0.3, 0.7)  # share of the flight: outside, the sole is near a surface
    cop_force_n: float = 50.0  # per foot: below, the CoP is a quotient of two small numbers
    heel_up_mm: float = 5.0  # heel height from which the foot counts as tipped
    friction_force_n: float = 10.0  # per foot: below, the ratio is taken to this force instead
    torsion_arm_m: float = 0.05  # half width of a sole: lever of the friction that resists turning on the spot
    torque_floor: float = 0.01  # of the peak torque: left at the speed limit, so that shares stay finite
    sole_points: int = 7  # along each edge of the sole: a platform's edge cannot pass between two of them
    same_level_m: float = 1e-3  # corners this close to the lowest one belong to the sole
    edge_room_m: float = 0.05  # from a sole to the edge of what it stands on: a playback that falls short still lands
    collision_step: int = 2  # samples: the fastest hand moves 2 cm meanwhile, and contact between links lasts longer
    block_m: float = 20.0  # size of the platform's block, larger than any jump


@dataclass(frozen=True)
class Limit:
    """What a check allows: ``limit`` in ``unit``; ``note`` says what is measured, with braces for what is found."""

    group: str
    name: str
    limit: float
    unit: str
    note: str
    at_least: bool = False

    def check(self, value: float, time: float | None = None, **found) -> Check:
        """Check of one value, which occurs at a time [s]."""
        note = self.note.format(**asdict(METHOD), **found)
        return Check(self.group, self.name, value, self.limit, self.unit, time, note, self.at_least)

    def worst(self, values: np.ndarray, t: np.ndarray, labels: Sequence[str] | None = None, **found) -> Check:
        """Check of the worst entry of ``values`` (N,) or (N, M) over the times ``t`` (N,) [s].

        ``labels`` (M,) name the columns; the worst one's is added to the note. Not a number counts as worst; no rows at
        all give the limit itself, with no time, since nothing was there to break it.
        """
        values = np.asarray(values, float)
        if values.size == 0:
            value, time, where = self.limit, None, " (nothing to check)"
        else:
            ranked = np.where(np.isnan(values), np.inf, -values if self.at_least else values)
            at = np.unravel_index(int(np.argmax(ranked)), values.shape)
            value, time = float(values[at]) + 0.0, float(t[at[0]])  # no minus zero
            where = "" if labels is None else f"; worst: {labels[at[1]]}"
        note = self.note.format(**asdict(METHOD), **found) + where
        return Check(self.group, self.name, value, self.limit, self.unit, time, note, self.at_least)


METHOD = Method()
_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
LIMITS = {name: Limit(group, name, *row) for group, rows in _TABLE.items() for name, row in rows.items()}
