"""Problems kept between processes: the small functions they are made of, serialised by CasADi, in a folder that may be
deleted.

A file is found by a hash of everything that its content depends on: this package's sources, CasADi's version, the robot
and the settings. It begins with a check sum; one that does not fit, for whatever reason, is passed over and replaced.
The folder is ``$JUMPLAB_CACHE``, or ``jumplab`` in ``$XDG_CACHE_HOME`` or ``~/.cache``; an empty ``$JUMPLAB_CACHE``
means that nothing is kept.
"""

from __future__ import annotations

import hashlib
import json
import os
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np

from jumplab.ocp.assembly import Assembled
from jumplab.ocp.derivatives import FUNCTIONS, Element, defect_term
from jumplab.ocp.problem import Problem

PLACES = ("*.py", "ocp/*.py", "models/*.py", "robot/*.py", "robot_import/*.py", "stages/srmp/*.py")
SOURCES = (*PLACES, "stages/whole_body/*.py")  # all that a problem is built by


def folder() -> Path | None:
    """Where files are kept; None if nowhere."""
    named = os.environ.get("JUMPLAB_CACHE")
    if named is not None:
        return Path(named) if named.strip() else None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jumplab"


@cache
def _sources() -> str:
    here, found = Path(__file__).parent.parent, hashlib.sha256(ca.CasadiMeta.version().encode())
    for path in sorted(path for pattern in SOURCES for path in here.glob(pattern)):
        found.update(path.read_bytes())
    return found.hexdigest()


def assembled(problem: Problem, key: str | None = None) -> Assembled:
    """The problem assembled, from the file of ``key`` if there is a sound one, else anew and then kept.

    ``key`` says everything that the problem was made of besides the sources and its mesh, which the file does not
    depend on; None keeps nothing.
    """
    place = None if key is None else folder()
    if place is None:
        return Assembled(problem)
    path = place / (hashlib.sha256(f"{_sources()} {problem.name} {key}".encode()).hexdigest()[:32] + ".casadi")
    known = _read(path, problem)
    if known is not None:
        return Assembled(problem, known)
    fresh = Assembled(problem)
    _write(path, fresh)
    return fresh


def _write(path: Path, a: Assembled) -> None:
    """Whole or not at all; a folder that cannot be written is no reason to fail."""
    head, texts = [], []
    for e in a.elements:
        made = [(name, *e.function(name)) for name in FUNCTIONS if e.costs or name not in ("costs", "gauss_newton")]
        head.append({
            "owner": e.owner, "place": e.place, "ny": e.ny, "costs": [t.name for t in e.costs],
            "rows": [(t.name, count) for t, count in e.rows],
            "made": [(name, rows.tolist(), cols.tolist()) for name, _, rows, cols in made],
        })  # fmt: skip
        texts += [function.serialize().encode() for _, function, *_ in made]
    head = json.dumps({"elements": head, "sizes": [len(text) for text in texts]}).encode()
    body = b"\n".join([head, b"".join(texts)])
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True) if part.parent.is_dir() else None


def _read(path: Path, problem: Problem) -> list[Element] | None:
    """The elements of a sound file of this problem, else None."""
    try:
        total, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() != total:
            return None
        head, _, texts = body.partition(b"\n")
        known, at, functions = json.loads(head), 0, []
        for size in known["sizes"]:
            functions.append(ca.Function.deserialize(texts[at : at + size].decode()))
            at += size
        terms = {(owner, t.name): t for owner, t in problem.terms()}
        terms |= {(phase.name, defect_term().name): defect_term() for phase in problem.phases}
        return [_element(e, terms, functions) for e in known["elements"]]
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None


def _element(e: dict, terms: dict, functions: list[ca.Function]) -> Element:
    """One element of a file; takes its functions from the front of the list."""
    made = {name: (functions.pop(0), np.array(rows, int), np.array(cols, int)) for name, rows, cols in e["made"]}
    rows = [(terms[e["owner"], name], count) for name, count in e["rows"]]
    return Element(e["owner"], e["place"], e["ny"], [terms[e["owner"], name] for name in e["costs"]], rows, made=made)
