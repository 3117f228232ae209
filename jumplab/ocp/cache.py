"""Built functions for later problems and processes, serialised by CasADi, in a folder that may be deleted.

A file holds one part of a problem (:class:`.Part`), so that problems which share a part share its functions. It is
named by a hash of all that its content depends on: what it is built by (:data:`BUILT_BY`), CasADi's version, the part's
own words, and the caller's key (robot and settings). It begins with a check sum; a file that does not fit it is passed
over and replaced. The folder is ``$JUMPLAB_CACHE``, else the user's cache folder of this system; an empty
``$JUMPLAB_CACHE`` means that nothing is kept.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from platformdirs import user_cache_path

from jumplab.errors import InputError
from jumplab.io.files import write_file
from jumplab.ocp import compiled
from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import FUNCTIONS, Element, ElementBuilder, Part
from jumplab.ocp.problem import Problem, layouts

HOME = ("jumplab.",)  # a problem with terms from elsewhere is not kept, unless it knows the hashes of their expressions
# modules and rooms that a problem is built by; a test walks the imports of the problems' modules and misses none
BUILT_BY = (
    "errors",
    "task",
    "ocp",
    "models",
    "robot",
    "robot_import",
    "stages.srmp",
    "stages.whole_body",
)


def folder() -> Path | None:
    """Where files are kept; None if nowhere."""
    named = os.environ.get("JUMPLAB_CACHE")
    if named is None:
        return user_cache_path("jumplab")
    return Path(named) if named.strip() else None


@cache
def _sources() -> str:
    """Hash of the sources of :data:`BUILT_BY`."""
    package, found = Path(__file__).parent.parent, hashlib.sha256()
    for name in BUILT_BY:
        place = package.joinpath(*name.split("."))
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
            found.update(path.read_bytes())
    return found.hexdigest()


def fingerprint(words: list, key: str) -> str:
    """Hash of what functions depend on: :meth:`.Part.words`, and ``key``, which says what they were made of besides."""
    made_of = [_sources(), ca.CasadiMeta.version(), words, key]
    return hashlib.sha256(json.dumps(made_of, default=lambda array: array.tolist()).encode()).hexdigest()


KNOWN: dict[str, Element] = {}  # of this process, by fingerprint


def assembled(problem: Problem, key: str | None = None) -> Assembled:
    """The problem assembled: each part from this process, from its file if that is sound, else made and then kept.

    ``key`` says what the problem was made of besides its words; None keeps nothing.
    """
    shipped = [t for owner, t in problem.terms() if (owner, t.name) not in problem.own]
    modules = {str(t.expression.__module__) for t in shipped}
    if key is None or not all(module.startswith(HOME) for module in modules):
        return Assembled(problem)
    builder = ElementBuilder(problem, layouts(problem))
    return Assembled(problem, [_kept(builder, part, key).placed(part) for part in builder.parts])


def _kept(builder: ElementBuilder, part: Part, key: str) -> Element:
    """The element of a part, as it was kept or to be kept."""
    digest, place = fingerprint(part.words(builder.problem), key)[:32], folder()
    if digest in KNOWN:
        return KNOWN[digest]
    path = None if place is None else place / f"{digest}.casadi"
    found = None if path is None else _read(path, part)
    if found is None:
        found = builder.build(part)
        if path is not None:
            with suppress(InputError):  # a folder that cannot be written is no reason to fail
                _write(path, found)
    KNOWN[digest] = found
    return found


def remembered(name: str, key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Plain data that takes long to compute, from its file if there is a sound one, else made and kept.

    ``key`` says what it was made of besides :data:`BUILT_BY`; numbers come back to the last bit.
    """
    if (place := folder()) is None:
        return make()
    digest = hashlib.sha256(json.dumps([_sources(), name, key]).encode()).hexdigest()
    path = place / f"{digest[:32]}.json"
    try:
        total, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() == total:
            return json.loads(body)
    except (OSError, ValueError):
        pass
    found = make()
    body = json.dumps(found).encode()
    with suppress(InputError):  # a folder that cannot be written is no reason to fail
        write_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
    return found


def _write(path: Path, e: Element) -> None:
    """Counts of the rows, and the functions with the places of their entries."""
    names = [name for name in FUNCTIONS if e.costs or name not in ("costs", "gauss_newton")]
    made = [(name, *e.function(name)) for name in names]
    functions = [(name, f.serialize(), rows.tolist(), cols.tolist()) for name, f, rows, cols in made]
    body = json.dumps([[n for _, n in e.rows], functions]).encode()
    write_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


def _read(path: Path, part: Part) -> Element | None:
    """The element of a part from a sound file, else None."""
    try:
        total, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() != total:
            return None
        counts, functions = json.loads(body)
        code, made = compiled.library(path), {}
        for name, f, i, j in functions:
            function = compiled.function(code, name) if code else ca.Function.deserialize(f)
            made[name] = function, np.array(i, int), np.array(j, int)
        rows = zip([t for t in part.terms if not t.is_cost], counts, strict=True)
        return Element(part.owner, part.place, [t for t in part.terms if t.is_cost], list(rows), made=made)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None
