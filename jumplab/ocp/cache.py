"""Store of objects that take long to make, for later problems and processes, in a folder that may
be deleted.

A file is named by a hash of all that its content depends on: what it is built by
(:data:`BUILT_BY`), CasADi's version, the words that say what it is, and the caller's key (robot and
settings). It begins with a check sum; a file that does not fit it is passed over and replaced. A
serialised function can name a library to load, so that reading it may run foreign code: folder and
files are private to the user, and what others own or can write is passed over. The
folder is ``$JUMPLAB_CACHE``, else the user's cache folder of this system; an empty
``$JUMPLAB_CACHE`` means that nothing is kept. Functions are kept by parts of a problem
(:class:`.Part`), so that problems which share a part share its functions.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from threading import RLock
from typing import Any, TypeVar

import casadi as ca
from platformdirs import user_cache_path

from jumplab import reading
from jumplab.errors import InputError
from jumplab.io.files import write_file
from jumplab.ocp.derivatives import Formulator, Part
from jumplab.ocp.problem import Problem

# a problem with terms from elsewhere is not kept, unless it knows the hashes of their expressions
HOME = ("jumplab.",)
# modules and sub-packages that a problem is built by; a test walks the imports of the problems'
# modules and misses none
BUILT_BY = (
    "errors",
    "arguments",
    "reading",
    "task",
    "ocp",
    "models",
    "robot",
    "stages.srmp",
    "stages.whole_body",
)
KNOWN: dict[str, dict[str, ca.Function]] = {}  # of this process, by fingerprint
# CasADi's expressions, and ipopt with MUMPS, are no affair of two threads, and equal parts are
# shared by all planners: threads build and solve in turn
TURN = RLock()
F = TypeVar("F", bound=Callable)


def in_turn(work: F) -> F:
    """The same function, which one thread of this process runs at a time."""

    @wraps(work)
    def waiting(*args: Any, **options: Any) -> Any:
        with TURN:
            return work(*args, **options)

    return waiting


def folder() -> Path | None:
    """Folder of the kept files; None if nothing is kept."""
    named = os.environ.get("JUMPLAB_CACHE")
    if named is None:
        return user_cache_path("jumplab")
    return Path(named) if named.strip() else None


@cache
def _sources() -> str:
    """Hash of the sources of :data:`BUILT_BY`."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for name in BUILT_BY:
        place = package.joinpath(*name.split("."))
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def fingerprint(words: list, key: str) -> str:
    """Hash of what something depends on: ``words`` (plain data and arrays), the caller's ``key``,
    and the code.
    """
    made_of = [_sources(), ca.CasadiMeta.version(), words, key]
    text = json.dumps(made_of, default=lambda array: array.tolist())
    return hashlib.sha256(text.encode()).hexdigest()


def remembered(words: list, key: str, make: Callable[[], Any]) -> Any:
    """Plain data that takes long to compute, from its file if there is a sound one, else made and
    kept.

    ``words`` and ``key`` as in :func:`fingerprint`; numbers come back to the last bit.
    """
    place = folder()
    if place is None:
        return make()
    path = place / f"{fingerprint(words, key)[:32]}.json"
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        reading.require_private(place, place.lstat())
        with reading.opened(path, "report", link=False) as file:
            reading.require_private(path, os.fstat(file.fileno()))
            total, _, body = file.read().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() == total:
            return json.loads(body)
    except (OSError, ValueError, InputError):
        pass
    data = make()
    body = json.dumps(data).encode()
    # a folder that cannot be written, or that others can write, is no reason to fail
    with suppress(OSError, InputError):
        reading.require_private(place, place.lstat())
        write_file(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body, mode=0o600)
    return data


def functions(
    problem: Problem, parts: Sequence[Part], key: str | None
) -> list[dict[str, ca.Function]]:
    """The functions of every part, see :meth:`.Formulas.functions`; parts of equal words share
    theirs.

    ``key`` says what the problem was made of besides its words; then functions come from this
    process or from their file, else they are made and kept. None keeps nothing.
    """
    shipped = [t for owner, t in problem.terms() if (owner, t.name) not in problem.own]
    if not all(str(t.expression.__module__).startswith(HOME) for t in shipped):
        key = None
    known = {} if key is None else KNOWN
    formulator = Formulator(problem)
    out = []
    for part in parts:
        words = part.words(problem)
        digest = fingerprint(words, key or "")
        if digest not in known:
            known[digest] = _functions_of(formulator, part, words, key)
        out.append(known[digest])
    return out


def _functions_of(formulator: Formulator, part: Part, words: list, key: str | None) -> dict:
    """The functions of a part, from the cache or built."""
    if key is None:
        return formulator.formulas(part).functions()
    fresh = {}

    def make():
        fresh.update(formulator.formulas(part).functions())
        return {name: f.serialize() for name, f in fresh.items()}

    texts = remembered(words, key, make)
    return fresh or {name: ca.Function.deserialize(text) for name, text in texts.items()}
