"""A problem with own terms, other weights, and some terms left out; what does not fit is refused
before any solve.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from numbers import Real
from typing import Any

import casadi as ca
import numpy as np

from jumplab.errors import InputError, quoted, require_type
from jumplab.ocp.derivatives import JERK_CHAIN, Formulator, Part
from jumplab.ocp.problem import Problem, Term, is_named


def changed(
    problem: Problem,
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Iterable[str] = (),
    *,
    look: Callable[[Problem, str, Term, str], str] | None = None,
) -> Problem:
    """The problem with own terms, other weights, and terms and bounds left out; itself if nothing
    is asked for.

    Parameters
    ----------
    terms : phase name -> further terms; by the problem's own name those at "problem", which join
        phases.
    weights : "term" or "phase/term" of a cost, own ones too -> weight.
    off : "term" or "phase/term" to leave out.
    look : takes the problem, a phase's name, an own term and its name in sentences; refuses the
        term if its expression does not fit, and returns a hash of it. If None, expressions are
        columns of a :class:`.problem.Point`.

    An own cost of weight 0 is left out as well, so that it changes nothing, not even a digit.

    Raises
    ------
    InputError
        In one sentence with the term's name: an unknown phase or name; a name taken twice; a weight
        that is no number
        of 0 or more, or is a constraint's; an expression that fails, is no column, or uses symbols
        that are not its
        point's; bounds that do not fit; a link of the motion that is switched off.
    """
    weights = dict(weights or {})
    off = tuple(off)
    if not (terms or weights or off):
        return problem
    for owner, extra in (terms or {}).items():
        for term in extra:
            problem = _with(problem, owner, term, look or _digest)
    problem.check_names(off)
    asked: dict[tuple[str, str], float] = {}
    for name, weight in weights.items():
        costs = problem.costs(name)
        check_weight(f"weight {name!r}", weight)
        asked |= dict.fromkeys(costs, float(weight))
    for owner, term in problem.terms():
        if term.identity and is_named(owner, term, off):
            raise InputError(
                f"term {term.name!r} ties the plan into one motion, as dynamics and links do; it "
                f"cannot be switched off"
            )

    def kept(owner, items):
        """Those that are not left out, with the weights that are asked for."""
        remaining = []
        for x in items:
            place = owner, x.name
            if place in asked:
                x = replace(x, weight=asked[place])
            if not (is_named(owner, x, off) or (place in problem.own and x.weight == 0)):
                remaining.append(x)
        return tuple(remaining)

    phases = tuple(
        replace(p, terms=kept(p.name, p.terms), bounds=kept(p.name, p.bounds))
        for p in problem.phases
    )
    out = replace(problem, phases=phases, joints=kept(problem.name, problem.joints))
    left = {(owner, t.name) for owner, t in out.terms()}
    return replace(out, own={name: digest for name, digest in problem.own.items() if name in left})


def check_weight(words: str, weight: Any, it: str = "it") -> None:
    """Refuse (:class:`InputError`) a weight, "weight 'name'" in ``words``, that cannot be one."""
    if isinstance(weight, bool) or not isinstance(weight, Real) or not 0 <= weight < np.inf:
        raise InputError(f"{words} = {quoted(weight)}: {it} must be a number of 0 or more")


def _with(problem: Problem, owner: str, term: Term, look: Callable) -> Problem:
    """The problem with one further term, checked."""
    require_type(term, Term, f"an own term of {problem.place(owner)!r}")
    who = f"term {term.name!r} of {problem.place(owner)!r}"
    names = [p.name for p in problem.phases]
    joining = owner == problem.name
    if not joining and owner not in names:
        raise InputError(
            f"term {term.name!r}: {problem.name!r} has no phase {owner!r}; it has "
            f"{', '.join(names)}, and {problem.name!r} for terms that join them"
        )
    if joining and term.at != "problem":
        raise InputError(f"{who}: at = {term.at!r}, must be 'problem' for a term that joins phases")
    if term.at == "problem" and not joining:
        raise InputError(
            f"{who}: at = 'problem' joins phases; add the term to {problem.name!r} instead"
        )
    if term.name in {JERK_CHAIN, *(x.name for o, x in problem.items() if o == owner)}:
        raise InputError(f"{who}: another term has this name; choose another one")
    if "/" in term.name:
        raise InputError(f"{who}: a name must not hold a '/'")
    if term.is_cost:
        check_weight(f"weight {term.name!r}", term.weight)
    phases = tuple(
        replace(p, terms=(*p.terms, term)) if p.name == owner else p for p in problem.phases
    )
    joints = (*problem.joints, term) if joining else problem.joints
    digests = {**problem.own, (owner, term.name): look(problem, owner, term, who)}
    return replace(problem, phases=phases, joints=joints, own=digests)


def _digest(problem: Problem, owner: str, term: Term, who: str) -> str:
    """Hash of the term's expression in the symbols of its points, the same in every process."""
    place = "interval" if term.at == "mid" else term.at
    f = Formulator(problem).formulas(Part(owner, place, (term,)))
    columns = [y for _, y in f.costs] + f.rows
    function = ca.Function("own", [f.local, f.data, f.parameters], columns, {"allow_free": True})
    if function.has_free():
        free = ", ".join(function.get_free()[:3])
        raise InputError(
            f"{who}: it uses symbols from outside its point ({free}); use only those of its point"
        )
    # bounds that are functions are read when solving
    if not (term.is_cost or callable(term.lower) or callable(term.upper)):
        ends(who, term, columns[0].numel())
    return hashlib.sha256(function.serialize().encode()).hexdigest()


def ends(who: str, term: Term, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound (rows,) of an own term, both numbers.

    ``who`` is the term in sentences. Raises InputError for bounds that are no numbers, do not fit
    the ``rows`` of its expression, or exclude each other.
    """
    values = []
    for side, bound in (("lower", term.lower), ("upper", term.upper)):
        try:
            value = np.asarray(bound, float).ravel()
        except (TypeError, ValueError):
            raise InputError(f"{who}: {side} = {quoted(bound)} is not a number") from None
        if value.size not in (1, rows) or np.any(np.isnan(value)):
            count = f"{rows} row{'s' * (rows > 1)}"
            raise InputError(
                f"{who}: {side} = {quoted(bound)} does not fit its expression, which has {count}; "
                "give one number, or one per row"
            )
        values.append(np.broadcast_to(value, (rows,)))
    low, high = values
    if np.any(low > high):
        raise InputError(
            f"{who}: lower = {quoted(term.lower)} is above upper = {quoted(term.upper)}"
        )
    return low, high
