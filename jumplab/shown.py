"""Objects that show themselves: one line wherever they are printed, a card with a picture in a notebook."""

from __future__ import annotations

from dataclasses import fields
from importlib import import_module


class Shown:
    """A dataclass with arrays in it, whose own text would flood a screen; declare it with ``repr=False``."""

    __slots__ = ()

    def line(self) -> str:
        """What there is to say of it, without line breaks; by default its plain values, and the names of the rest."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        plain = [f"{k}={x!r}" for k, x in values.items() if isinstance(x, str | int | float) and len(repr(x)) < 40]
        rest = [k for k in values if not any(text.startswith(f"{k}=") for text in plain)]
        return ", ".join([*plain, *rest])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.line()}>"

    def _repr_html_(self) -> str | None:
        return import_module("jumplab.show.cards").card(self)  # by name: pictures stand above whatever shows itself
