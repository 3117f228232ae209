"""Small tables for notebooks: rows of plain data, shown as HTML in a notebook and as text anywhere else."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np

from jumplab.io import folder


@dataclass(frozen=True, repr=False)
class Table:
    """A finished table of texts; make one with :func:`table`."""

    columns: tuple[str, ...]  # headings
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]  # which columns are numbers, set flush right

    def __repr__(self) -> str:
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        lines = []
        for row in (self.columns, ["-" * w for w in widths], *self.rows):
            pairs = zip(row, widths, self.right, strict=True)
            cells = (text.rjust(width) if right else text.ljust(width) for text, width, right in pairs)
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            sides = ("right" if right else "left" for right in self.right)
            pairs = zip(sides, map(html.escape, cells), strict=True)
            return "".join(["<tr>", *(f'<{tag} style="text-align:{side}">{c}</{tag}>' for side, c in pairs), "</tr>"])

        body = "".join(row(r, "td") for r in self.rows)
        return f"<table><thead>{row(self.columns, 'th')}</thead><tbody>{body}</tbody></table>"


def table(
    rows: Iterable[Mapping], columns: Iterable[str] | None = None, *, digits: int = 4, decimals: int | None = None
) -> Table:
    """Rows of named values as a :class:`Table`; a missing value is left blank.

    ``columns`` says which keys, in which order, those of the first row if None; a mapping renames them. Numbers have
    ``digits`` significant digits, or ``decimals`` places after the point if they are not whole by type.
    """
    rows = list(rows)
    if columns is None:
        columns = list(rows[0]) if rows else []
    names = dict(columns) if isinstance(columns, Mapping) else {c: c for c in columns}
    form = f".{digits}g" if decimals is None else f"z.{decimals}f"  # z: no minus before a zero
    cells = [tuple(_text(r.get(key), form) for key in names) for r in rows]
    right = tuple(bool(rows) and all(_number(r.get(key)) or r.get(key) is None for r in rows) for key in names)
    return Table(tuple(names.values()), tuple(cells), right)


def _number(x: Any) -> bool:
    return isinstance(x, Real) and not isinstance(x, bool)


def _text(x: Any, form: str) -> str:
    if x is None:
        return ""
    if isinstance(x, bool | np.bool_):
        return "yes" if x else "no"
    if isinstance(x, Integral):
        return str(int(x))
    if _number(x):
        return f"{float(x):{form}}" if math.isfinite(x) else "—"
    return str(x)


def versions() -> Table:
    """The versions of Python and of every package that shapes a result."""
    return table([{"package": name, "version": version} for name, version in folder.versions().items()])
