"""Assembled problems kept between processes: CasADi's own serialised functions, in a folder that may be deleted.

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

from jumplab.terms import Problem
from jumplab.transcription import Assembled

FUNCTIONS = ("nlp", "grad_f", "jac_g", "hess_lag", "cost_parts", "gauss_newton")
SOURCES = ("*.py", "models/*.py", "robot/*.py", "srmp/*.py", "whole_body/*.py")  # all that a problem is built by


def folder() -> Path | None:
    """Where files are kept; None if nowhere."""
    named = os.environ.get("JUMPLAB_CACHE")
    if named is not None:
        return Path(named) if named.strip() else None
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jumplab"


@cache
def _sources() -> str:
    here, found = Path(__file__).parent, hashlib.sha256(ca.CasadiMeta.version().encode())
    for path in sorted(path for pattern in SOURCES for path in here.glob(pattern)):
        found.update(path.read_bytes())
    return found.hexdigest()


def assembled(problem: Problem, key: str | None = None, like: Assembled | None = None) -> Assembled:
    """The problem assembled, from the file of ``key`` if there is a sound one, else anew and then kept.

    ``key`` says everything that the problem was made of besides the sources; None keeps nothing. ``like`` is the same
    problem on another mesh, which saves work.
    """
    place = None if key is None else folder()
    if place is None:
        return Assembled(problem, like=like)
    path = place / (hashlib.sha256(f"{_sources()} {problem.name} {key}".encode()).hexdigest()[:32] + ".casadi")
    known = _read(path)
    if known is not None:
        try:
            return Assembled(problem, known)
        except (KeyError, TypeError, ValueError):
            pass  # sound but not of this problem
    fresh = Assembled(problem, like=like)
    _write(path, fresh)
    return fresh


def _write(path: Path, a: Assembled) -> None:
    """Whole or not at all; a folder that cannot be written is no reason to fail."""
    texts = [getattr(a, name).serialize().encode() for name in FUNCTIONS]
    rows = [(row.owner, row.term.name, row.node, row.component) for row in a.rows]
    costs = [(owner, term.name) for owner, term in a.cost_terms]
    head = json.dumps({"rows": rows, "costs": costs, "sizes": [len(text) for text in texts]}).encode()
    body = b"\n".join([head, b"".join(texts)])
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True) if part.parent.is_dir() else None


def _read(path: Path) -> dict | None:
    """Rows, cost terms and functions of a sound file, else None."""
    try:
        total, _, body = path.read_bytes().partition(b"\n")
        if hashlib.sha256(body).hexdigest().encode() != total:
            return None
        head, _, texts = body.partition(b"\n")
        known, at = json.loads(head), 0
        for name, size in zip(FUNCTIONS, known["sizes"], strict=True):
            known[name] = ca.Function.deserialize(texts[at : at + size].decode())
            at += size
        return known
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None
