"""One root for every error that jumplab raises on purpose, and for all objects that say in a line
what they are.

A message says what is wrong, where, the value, the limit and what to do. The command line prints
the message alone and exits with ``exit_code``.
"""

import os
import re
import reprlib
from collections.abc import Callable, Iterable
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, ClassVar

LISTED = 8  # names that a message lists
NAME_BYTES = 256  # of a name that is too long for usual file systems
_ENDLESS = re.compile(r"\S{240,}")
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60  # enough to recognise what one has typed


class JumplabError(Exception):
    """Root of all deliberate errors of the package."""

    exit_code = 4

    def __init__(self, message: str, **facts: Any):
        # a value of thousands of characters is not quoted whole, wherever it comes from
        super().__init__(_ENDLESS.sub(lambda word: f"{word[0][:60]}...{word[0][-60:]}", message))
        vars(self).update(facts)  # of those that the class names


class InputError(JumplabError):
    """The caller asked for something that cannot be meant: a bad target, file, option or robot."""

    exit_code = 2


class RobotError(InputError):
    """A robot description is missing something, or says something impossible."""


class InfeasibleError(JumplabError):
    """The question is well posed, but this robot cannot do it (or no plan was found within the
    limits).
    """

    exit_code = 3
    number = ""  # what of the target is beyond its limit, such as "distance_m"
    bound: float | None = None  # the limit [m]


class SolverError(JumplabError):
    """A solver stopped without an answer that passes its own re-evaluated residuals."""

    exit_code = 3
    stage = ""  # that failed
    status = ""  # what the solver said, after how many iterations
    iterations = 0
    # the worst violated terms, each as "name: amount unit at node k, t = ... s"
    violations: tuple[str, ...] = ()
    # those that hold back the best compromise, if one was looked for, as
    # :func:`jumplab.ocp.posing.binding` has them
    limits: tuple = ()


def quoted(value: Any) -> str:
    """A value as a message may quote it: one line, not long, whatever it is."""
    return " ".join(_SHORT.repr(value).split())


def nearest(names: Iterable[str], to: Any) -> str:
    """The names that there are, of many those nearest ``to`` what was asked for, as a message may
    list them ("knee, hip and 3 more").
    """
    names = sorted(names)
    if len(names) <= LISTED:
        return ", ".join(names)
    near = get_close_matches(str(to).rpartition("/")[2], names, LISTED, 0)
    return f"{', '.join(near)} and {len(names) - LISTED} more"


def require_type(value: Any, kind: type, what: str) -> None:
    """Refuse (:class:`InputError`) a value of another type, before it fails somewhere inside."""
    if not isinstance(value, kind):
        raise InputError(f"{what} must be a {kind.__name__}, got {quoted(value)}")


def as_path(value: Any, what: str) -> Path:
    """A path from what the caller gave; refuses (:class:`InputError`) what names no file."""
    if isinstance(value, str | os.PathLike) and value != "" and isinstance(os.fspath(value), str):
        path = Path(value)
        if "\0" in str(path) or any(len(os.fsencode(x)) >= NAME_BYTES for x in path.parts):
            raise InputError(f"{what} = {quoted(value)} cannot be the name of a file or folder")
        return path
    raise InputError(f"{what} must be a path, got {quoted(value)}")


# objects ------------------------------------------------------------------------------------------
class Shown:
    """A dataclass with arrays in it, whose own text would flood a screen; declare it with
    ``repr=False``.
    """

    __slots__ = ()
    # gives the module that draws results; the front door names it, since pictures stand above
    pictures: ClassVar[Callable[[], Any]]

    def line(self) -> str:
        """Summary in one line; by default its plain values, and the names of the rest."""
        plain, rest = [], []
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if isinstance(value, str | int | float) and len(repr(value)) < 40:
                plain.append(f"{name}={value!r}")
            else:
                rest.append(name)
        return ", ".join(plain + rest)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.line()}>"

    def _repr_html_(self) -> str | None:
        return Shown.pictures().card(self)
