"""Built problems for later processes: their small functions, serialised by CasADi, in a folder that may be deleted.

A file is named by a hash of all that its content depends on: what it is built by (:data:`BUILT_BY`), CasADi's version,
the problem's own words, and the caller's key (robot and settings). It begins with a check sum; a file that does not fit
it is passed over and replaced. The folder is ``$JUMPLAB_CACHE``, else the user's cache folder of this system; an empty
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
from jumplab.ocp.derivatives import FUNCTIONS, JERK_CHAIN, Element, chain_term
from jumplab.ocp.problem import Problem

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
    "stages.spatial",
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


def _words(problem: Problem) -> list:
    """What a problem says of itself, but for its mesh and the values of bounds and weights, which are data."""
    own = [(*name, digest) for name, digest in problem.own.items()]
    phases = [
        (p.name, p.coordinates, p.states, {name: c[2] for name, c in p.constants.items()}, p.references, p.scales)
        for p in problem.phases
    ]
    terms = [(owner, t.name, t.equation, t.at, t.is_cost, t.scale) for owner, t in problem.terms()]
    bounds = [(owner, b.name, b.equation, b.on, b.where) for owner, b in problem.bounds()]
    return [problem.name, problem.parameters, phases, terms, bounds, own]


def fingerprint(problem: Problem, key: str) -> str:
    """Hash of what a problem and its solutions depend on; ``key`` says what it was made of besides its words."""
    made_of = [_sources(), ca.CasadiMeta.version(), _words(problem), key]
    return hashlib.sha256(json.dumps(made_of, default=lambda array: array.tolist()).encode()).hexdigest()


def assembled(problem: Problem, key: str | None = None) -> Assembled:
    """The problem assembled, from the file of ``key`` if there is a sound one, else anew and then kept.

    ``key`` says what the problem was made of besides its words; None keeps nothing.
    """
    shipped = [t for owner, t in problem.terms() if (owner, t.name) not in problem.own]
    place, modules = folder(), {str(t.expression.__module__) for t in shipped}
    if key is None or place is None or not all(module.startswith(HOME) for module in modules):
        return Assembled(problem)
    path = place / f"{fingerprint(problem, key)[:32]}.casadi"
    known = _read(path, problem)
    if known is not None:
        return Assembled(problem, known)
    fresh = Assembled(problem)
    with suppress(InputError):  # a folder that cannot be written is no reason to fail
        _write(path, fresh.elements)
    return fresh


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


def _write(path: Path, elements: list[Element]) -> None:
    """One list per element: owner, place, names of costs, names and counts of rows, functions with their places."""
    told = []
    for e in elements:
        names = [name for name in FUNCTIONS if e.costs or name not in ("costs", "gauss_newton")]
        made = [(name, *e.function(name)) for name in names]
        functions = [(name, f.serialize(), rows.tolist(), cols.tolist()) for name, f, rows, cols in made]
        told.append((e.owner, e.place, [t.name for t in e.costs], [(t.name, n) for t, n in e.rows], functions))
    body = json.dumps(told).encode()
    write_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


def _read(path: Path, problem: Problem) -> list[Element] | None:
    """The elements of a sound file of this problem, else None."""
    try:
        total, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() != total:
            return None
        terms = {(owner, t.name): t for owner, t in problem.terms()}
        terms |= {(phase.name, JERK_CHAIN): chain_term(phase) for phase in problem.phases}
        found, code = [], compiled.library(path)
        for k, (owner, place, costs, rows, functions) in enumerate(json.loads(body)):
            made = {}
            for name, f, i, j in functions:
                function = compiled.function(code, k, name) if code else ca.Function.deserialize(f)
                made[name] = function, np.array(i, int), np.array(j, int)
            counts = [(terms[owner, name], n) for name, n in rows]
            found.append(Element(owner, place, [terms[owner, name] for name in costs], counts, made=made))
        return found
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None
