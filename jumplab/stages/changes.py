"""Own terms, weights and switches by stage: what a planner is asked to change, sorted out and
refused in words.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

from jumplab.errors import InputError, nearest, quoted, require_type
from jumplab.ocp import Problem, Term, changed
from jumplab.robot.legs import Size

LAUNCH = ("flat", "toe")  # phases of "launch" in stages 1 and 3
PHASES = {  # stage -> names of its phases; but for stage 2 "launch" means both of LAUNCH
    "srmp": (*LAUNCH, "launch", "flight"),
    "joint qp": ("launch", "flight"),
    "whole body": (*LAUNCH, "launch", "flight"),
}
LAST = "whole body"  # the stage of names without one; the direct planner takes its terms too
Settings = TypeVar("Settings")
Look = Callable[[Problem, str, Term, str], str]  # see :func:`jumplab.ocp.changed`


@dataclass(frozen=True)
class StageChanges:
    """Changes to one stage.

    Attributes
    ----------
    terms : phase -> own terms; "" -> those that join phases.
    weights : "term" or "phase/term" -> weight.  off : "term" or "phase/term".
    """

    terms: Mapping[str, tuple[Term, ...]] = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    off: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.terms or self.weights or self.off)

    def applied(self, problem: Problem, look: Look | None = None) -> Problem:
        """The problem with these changes (itself if there are none); see
        :func:`jumplab.ocp.changed` for ``look`` and for what is refused.
        """
        if not self:
            return problem
        terms = defaultdict(list)
        for phase, extra in self.terms.items():
            for owner, term in _placed(problem, phase or problem.name, extra):
                terms[owner].append(term)
        problem = changed(problem, terms, look=look)
        weights = self.spread(problem, self.weights)
        return changed(problem, weights=weights, off=self.spread(problem, dict.fromkeys(self.off)))

    @staticmethod
    def spread(problem: Problem, names: Mapping[str, Any]) -> dict[str, Any]:
        """The same ``names`` (name -> value) of a problem, "launch/term" split into the phases of
        the launch that have the term: ["flat/term", "toe/term"].
        """
        known = {(owner, x.name) for owner, x in problem.items()}
        spread = {}
        for name, value in names.items():
            phase, _, term = name.partition("/")
            split = [f"{x}/{term}" for x in LAUNCH if phase == "launch" and (x, term) in known]
            spread |= dict.fromkeys(split or [name], value)
        return spread


def _placed(problem: Problem, phase: str, terms: Iterable[Term]) -> list[tuple[str, Term]]:
    """(phase, term) of each; where a problem has the launch in two parts, those of "launch" are in
    both, with its start in the first, its end in the last.
    """
    if phase != "launch" or any(p.name == phase for p in problem.phases):
        return [(phase, term) for term in terms]
    out = []
    for term in terms:
        if term.at != "end":
            out.append((LAUNCH[0], replace(term, skip=(term.skip[0], 0))))
        if term.at != "start":
            out.append((LAUNCH[1], replace(term, skip=(0, term.skip[1]))))
    return out


def sorted_out(
    terms: Mapping[str, Iterable[Term]] | None = None,
    weights: Mapping[str, float] | None = None,
    off: Iterable[str] = (),
) -> dict[str, StageChanges]:
    """Changes by stage, from names as users write them.

    Parameters
    ----------
    terms : "stage/phase" -> own terms; "stage" alone for those at "problem", which join phases.
    weights, off : "stage/term" or "stage/phase/term"; without a stage the name is stage 3's.

    Raises
    ------
    InputError
        If a stage or phase is unknown, with those that exist, or something is of another type than
        it must be.
    """
    by_stage = {stage: ({}, {}, {}) for stage in PHASES}  # own terms, weights, switches
    terms, weights = ({} if x is None else x for x in (terms, weights))
    require_type(terms, Mapping, "own terms")
    require_type(weights, Mapping, "weights")
    if isinstance(off, str) or not isinstance(off, Iterable):
        raise InputError(f"off must be a list of names, got {quoted(off)}")
    for name, extra in terms.items():
        stage, phase = _stage_and_phase(name)
        extra = (extra,) if isinstance(extra, Term) else extra
        if isinstance(extra, str) or not isinstance(extra, Iterable):
            raise InputError(f"own terms of {name!r} must be a list of terms, got {quoted(extra)}")
        added = by_stage[stage][0]
        added[phase] = (*added.get(phase, ()), *extra)
        for term in added[phase]:
            require_type(term, Term, f"an own term of {name!r}")
    for kind, names in enumerate((weights, dict.fromkeys(off)), 1):
        for name, value in names.items():
            stage, rest = _stage_of(name)
            by_stage[stage][kind][rest] = value
    return {x: StageChanges(added, new, tuple(gone)) for x, (added, new, gone) in by_stage.items()}


def _stage_and_phase(name: Any) -> tuple[str, str]:
    stage, _, phase = name.lower().partition("/") if isinstance(name, str) else ("", "", "")
    if stage not in PHASES or phase not in ("", *PHASES[stage]):
        known = ", ".join(f"{s}/{p}" for s, phases in PHASES.items() for p in phases)
        raise InputError(
            f"own terms of {quoted(name)}: there is no such stage and phase; there are {known}"
        )
    return stage, phase


def _stage_of(name: Any) -> tuple[str, str]:
    """(stage, rest of the name); stage and phase in lower case."""
    if not isinstance(name, str):
        raise InputError(f"the name of a weight or switch must be a text, got {quoted(name)}")
    first, _, rest = name.partition("/")
    stage, rest = (first.lower(), rest) if first.lower() in PHASES else (LAST, name)
    phase, slash, term = rest.partition("/")
    return stage, f"{phase.lower()}/{term}" if slash else rest


def settled(
    kind: type[Settings],
    given: Settings | Mapping[str, Any] | None,
    flip: bool = False,
    size: Size | None = None,
) -> Settings:
    """Settings of a dataclass ``kind``: its defaults (of a flip, by ``of_flip``; of a robot's
    ``size``, by ``of_size``), and over them what was ``given``, see :func:`named`.
    """
    usual = kind().of_flip() if flip else kind()
    if size is not None and hasattr(usual, "of_size"):
        usual = usual.of_size(size)
    return replace(usual, **named(kind, given))


def named(kind: type[Settings], given: Settings | Mapping[str, Any] | None) -> dict[str, Any]:
    """The fields of a dataclass ``kind`` that were given: by a mapping of some, or a ``kind`` whose
    fields that differ from the defaults are meant [name -> value].

    Raises :class:`InputError` for an unknown field or a value of another sort.
    """
    usual = kind()
    names = [f.name for f in fields(kind)]
    if isinstance(given, kind):
        given = {n: getattr(given, n) for n in names if getattr(given, n) != getattr(usual, n)}
    given = {} if given is None else given
    if not isinstance(given, Mapping):
        raise InputError(f"give a {kind.__name__} or a mapping of its fields, got {quoted(given)}")
    for name, value in given.items():
        if name not in names:
            raise InputError(
                f"{kind.__name__} has no {quoted(name)}; it has {nearest(names, name)}"
            )
        if _sort(value) not in [_sort(getattr(x, name)) for x in (usual, usual.of_flip())]:
            raise InputError(
                f"{kind.__name__}: {name} = {quoted(value)} must be of the same kind as its "
                f"default, {getattr(usual, name)!r}"
            )
    return dict(given)


def _sort(value: Any) -> Any:
    """Of what sort a value is: nothing, a text, yes or no, a number (not nan), so many of them."""
    if isinstance(value, tuple):
        return tuple(map(_sort, value))
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float if value == value else None
    return type(value)
