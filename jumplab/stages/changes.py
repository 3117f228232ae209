"""Own terms, weights and switches by stage: what a planner is asked to change, sorted out and refused in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

from jumplab.errors import InputError, quoted, require_type
from jumplab.ocp import Problem, Term, changed

LAUNCH = ("flat", "toe")  # phases of "launch" in stages 1 and 3
PHASES = {  # stage -> names of its phases; but for stage 2 "launch" means both of LAUNCH
    "srmp": (*LAUNCH, "launch", "flight"),
    "joint qp": ("launch", "flight"),
    "whole body": (*LAUNCH, "launch", "flight"),
}
LAST = "whole body"  # the stage of names without one; the direct planner takes its terms too
Settings = TypeVar("Settings")


@dataclass(frozen=True)
class StageChanges:
    """What is changed about one stage.

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

    def applied(self, problem: Problem, like: Problem | None = None) -> Problem:
        """The problem of stage 1 or 3 with these changes; see :func:`jumplab.ocp.changed` for what is refused.

        With ``like``, a problem with these changes and more terms, names that only that one may have are passed over.
        """
        if not self:
            return problem
        terms: dict[str, tuple[Term, ...]] = {}
        for phase, extra in self.terms.items():
            for owner, term in _placed(phase or problem.name, extra):
                terms[owner] = (*terms.get(owner, ()), term)
        with_own = changed(problem, terms)
        weights, off = self.spread(with_own, self.weights), tuple(self.spread(with_own, dict.fromkeys(self.off)))
        if like is not None:
            known = _names(with_own)
            weights, off = {n: w for n, w in weights.items() if n in known}, tuple(n for n in off if n in known)
        return changed(with_own, weights=weights, off=off)

    @staticmethod
    def spread(problem: Problem, names: Mapping[str, Any] | None) -> dict[str, Any]:
        """The same, "launch/term" told for the phases of the launch that have the term."""
        out, known = {}, _names(problem)
        for name, value in (names or {}).items():
            phase, _, term = name.partition("/")
            parts = [n for n in (f"{part}/{term}" for part in LAUNCH) if n in known] if phase == "launch" else []
            out |= dict.fromkeys(parts or [name], value)
        return out

    def still_there(self, problem: Problem, names: Iterable[str]) -> tuple[str, ...]:
        """The names less those that these changes have already left out of the problem."""
        known, gone = _names(problem), {part for name in self.off for part in (name, name.rpartition("/")[2])}
        return tuple(name for name in names if name in known or name not in gone)


def _names(problem: Problem) -> set[str]:
    owned = [(owner, x.name) for owner, x in (*problem.terms(), *problem.bounds())]
    return {name for owner, n in owned for name in (n, f"{owner}/{n}")}


def _placed(phase: str, terms: Iterable[Term]) -> list[tuple[str, Term]]:
    """(phase, term) of each; those of "launch" in both its phases, with its start in the first, its end in the last."""
    out = []
    for term in terms:
        if phase != "launch":
            out.append((phase, term))
            continue
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
        If a stage or phase is unknown, with those that exist, or something is of another type than it must be.
    """
    own: dict[str, dict] = {stage: {} for stage in PHASES}
    require_type({} if terms is None else terms, Mapping, "own terms")
    for name, extra in (terms or {}).items():
        stage, phase = _stage_and_phase(name)
        extra = (extra,) if isinstance(extra, Term) else extra
        if isinstance(extra, str) or not isinstance(extra, Iterable):
            raise InputError(f"own terms of {name!r} must be a list of terms, got {quoted(extra)}")
        own[stage][phase] = (*own[stage].get(phase, ()), *extra)
        for term in own[stage][phase]:
            require_type(term, Term, f"an own term of {name!r}")
    require_type({} if weights is None else weights, Mapping, "weights")
    if isinstance(off, str):
        raise InputError(f"off must be a list of names, got {off!r}")
    scales, gone = ({stage: {} for stage in PHASES} for _ in range(2))
    for names, out in ((dict(weights or {}), scales), (dict.fromkeys(off), gone)):
        for name, value in names.items():
            stage, rest = _stage_of(name)
            out[stage][rest] = value
    return {stage: StageChanges(own[stage], scales[stage], tuple(gone[stage])) for stage in PHASES}


def _stage_and_phase(name: Any) -> tuple[str, str]:
    stage, _, phase = name.lower().partition("/") if isinstance(name, str) else ("", "", "")
    if stage not in PHASES or phase not in ("", *PHASES[stage]):
        known = ", ".join(f"{s}/{p}" for s, phases in PHASES.items() for p in phases)
        raise InputError(f"own terms of {quoted(name)}: there is no such stage and phase; there are {known}")
    return stage, phase


def _stage_of(name: Any) -> tuple[str, str]:
    """(stage, rest of the name); stage and phase in lower case."""
    if not isinstance(name, str):
        raise InputError(f"a weight or switch is named by a text, got {quoted(name)}")
    first, _, rest = name.partition("/")
    stage, rest = (first.lower(), rest) if first.lower() in PHASES else (LAST, name)
    phase, slash, term = rest.partition("/")
    return stage, f"{phase.lower()}/{term}" if slash else rest


def settled(kind: type[Settings], given: Settings | Mapping[str, Any] | None, flip: bool = False) -> Settings:
    """Settings of a dataclass ``kind``: its defaults (of a flip, by ``of_flip``), and over them what was given.

    ``given`` is a mapping of some fields, or a ``kind`` whose fields that differ from the defaults are what was given.
    Raises :class:`InputError` for an unknown field or a value of another sort.
    """
    usual, names = kind(), [f.name for f in fields(kind)]
    if isinstance(given, kind):
        given = {n: getattr(given, n) for n in names if getattr(given, n) != getattr(usual, n)}
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"{kind.__name__} or a mapping of its fields is needed, got {quoted(given)}")
    for name, value in (given or {}).items():
        if name not in names:
            raise InputError(f"{kind.__name__} has no {quoted(name)}; it has {', '.join(names)}")
        if not _alike(value, getattr(usual, name), getattr(usual.of_flip(), name)):
            raise InputError(f"{kind.__name__}: {name} = {quoted(value)} must be like {getattr(usual, name)!r}")
    return replace(usual.of_flip() if flip else usual, **(given or {}))


def _alike(value: Any, *examples: Any) -> bool:
    """Whether a value is of the sort of one of the examples: nothing, a number, a text, or as many of these."""
    for example in examples:
        if isinstance(example, tuple):
            if isinstance(value, tuple) and (isinstance(example[0], str) or len(value) == len(example)):
                if all(_alike(x, example[0]) for x in value):
                    return True
        elif isinstance(example, bool) or example is None or isinstance(example, str):
            if type(value) is type(example):
                return True
        elif isinstance(value, int | float) and not isinstance(value, bool) and value == value:
            return True
    return False
