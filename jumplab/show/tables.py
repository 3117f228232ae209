"""Small tables: rows of plain data, as HTML in a notebook and as text anywhere else."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from jumplab.arguments import checked
from jumplab.errors import InputError
from jumplab.forms import filled
from jumplab.io import folder

MOST_ROWS = 12  # of a table in a notebook; those below are folded
DIGITS_MOST = 17  # a float has no more


@checked
@dataclass(frozen=True, repr=False)
class Table:
    """A finished table of texts; make one with :func:`table`."""

    columns: tuple[str, ...]  # headings
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]  # which columns are numbers, set flush right

    def __repr__(self) -> str:
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        sides = [">" if right else "<" for right in self.right]
        form = "  ".join(f"{{:{side}{w}}}" for side, w in zip(sides, widths, strict=True))
        lines = (self.columns, ["-" * width for width in widths], *self.rows)
        return "\n".join(form.format(*line).rstrip() for line in lines)

    def _repr_html_(self) -> str:
        sides = ["right" if right else "left" for right in self.right]
        return filled(
            "show/table.html", columns=self.columns, rows=self.rows, sides=sides, most=MOST_ROWS
        )


def table(
    rows: Iterable[Mapping],
    columns: Iterable[str] | Mapping[str, str] | None = None,
    *,
    digits: int = 4,
    decimals: int | None = None,
) -> Table:
    """Rows of named values as a :class:`Table`; a missing value (or None) is left blank.

    ``columns`` says which keys, in which order, those of the first row if None; a mapping renames
    them. Numbers have ``digits`` significant digits, or ``decimals`` places after the point if they
    are not whole by type.
    """
    for name, places in (("digits", digits), ("decimals", decimals)):
        if places is not None and not 0 <= places <= DIGITS_MOST:
            raise InputError(f"{name} = {places} is outside 0 ... {DIGITS_MOST}")
    rows = list(rows)
    if columns is None:
        columns = list(rows[0]) if rows else []
    names = columns if isinstance(columns, Mapping) else {name: name for name in columns}
    form = f".{digits}g" if decimals is None else f"z.{decimals}f"  # z: no minus before a zero
    cells = tuple(tuple(_text(row.get(key), form) for key in names) for row in rows)
    right = tuple(
        bool(rows) and all(row.get(key) is None or _is_number(row[key]) for row in rows)
        for key in names
    )
    return Table(tuple(names.values()), cells, right)


def _is_number(x: Any) -> bool:
    return isinstance(x, Real) and not isinstance(x, bool)


def _text(x: Any, form: str) -> str:
    if x is None:
        return ""
    if isinstance(x, bool | np.bool_):
        return "yes" if x else "no"
    if not _is_number(x) or isinstance(x, Integral):
        return str(x)
    return f"{float(x):{form}}" if math.isfinite(x) else "—"


def versions() -> Table:
    """The versions of Python and of every package that shapes a result."""
    return table(
        [{"package": name, "version": version} for name, version in folder.versions().items()]
    )
