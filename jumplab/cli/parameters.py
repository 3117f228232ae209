"""A notebook's parameters: what it declares, and the refusal of what is unknown or cannot be meant."""

from __future__ import annotations

import ast
import contextlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jumplab.errors import InputError, quoted
from jumplab.task import JumpTask

STANDARD = {"distance_m": float, "height_m": float, "robot": str, "out": str, "figures": str}
INJECTED = "# Parameters\n"  # how the cell begins that papermill adds


def check_parameters(namespace: Mapping[str, Any], **extra: type | range) -> None:
    """Refuse injected parameters that a notebook does not know, and values that cannot be meant.

    papermill merely warns of an unknown name and then runs with the default. Call this in the cell after the
    parameters: ``check_parameters(globals(), samples=range(1, 10_001), fast=bool)``.

    Parameters
    ----------
    namespace : the notebook's ``globals()``.
    extra : further parameters of this notebook: a type, or a range for a whole number within it; those of
        ``STANDARD`` are always known.

    Raises
    ------
    InputError
        Naming the parameter, its value and what it should be.
    """
    known = {**STANDARD, **extra}
    cells = [source for source in namespace.get("In", []) if source.startswith(INJECTED)]
    for target in (t for n in ast.walk(ast.parse("\n".join(cells))) if isinstance(n, ast.Assign) for t in n.targets):
        if isinstance(target, ast.Name) and target.id not in known:
            raise InputError(f"unknown notebook parameter {target.id!r}; this notebook knows {', '.join(known)}")
    for name, kind in known.items():
        if name in namespace:
            check_value(name, namespace[name], kind)
    if "distance_m" in namespace or "height_m" in namespace:
        JumpTask(namespace.get("distance_m", 0.0), namespace.get("height_m", 0.5))


def check_value(name: str, value: Any, kind: type | range) -> None:
    """Refuse (:class:`InputError`) a value that is not of the kind: a type, or a range of whole numbers."""
    if isinstance(kind, range):
        check_value(name, value, int)
        if value not in kind:
            raise InputError(f"parameter {name} must be {kind.start} ... {kind.stop - 1}, got {value}")
        return
    wanted = int | float if kind is float else kind
    if not isinstance(value, wanted) or (isinstance(value, bool) and kind is not bool):
        raise InputError(f"parameter {name} must be of type {kind.__name__}, got {quoted(value)}")
    if kind is float and not math.isfinite(value):
        raise InputError(f"parameter {name} must be finite, got {value}")
    if kind is str and (not value or "\0" in value):
        raise InputError(f"parameter {name} must be a name or a path, got {quoted(value)}")


def declared_parameters(notebook: Path) -> tuple[str, ...]:
    """Names that the notebook's ``parameters`` cell declares."""
    from papermill import inspect_notebook

    try:
        return tuple(inspect_notebook(literal(notebook)))
    except Exception as e:  # nbformat raises a whole zoo
        raise InputError(f"{notebook}: not a readable notebook ({type(e).__name__})") from e


def declared_kinds(notebook: Path) -> dict[str, type | range]:
    """What the notebook's own ``check_parameters`` asks of its further parameters, read without running it.

    What cannot be read that way is left out: the notebook itself will still refuse it.
    """
    found: dict[str, type | range] = {}
    for cell in json.loads(notebook.read_bytes())["cells"]:
        with contextlib.suppress(SyntaxError, ValueError, TypeError):  # text, magics, a range of variables
            for call in ast.walk(ast.parse("".join(cell["source"]))):
                if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "check_parameters":
                    kinds = {k.arg: _kind(k.value) for k in call.keywords if k.arg}
                    found |= {name: kind for name, kind in kinds.items() if kind is not None}
    return found


def _kind(node: ast.expr) -> type | range | None:
    """``int``, ``bool``, ``float``, ``str``, or ``range(a, b)``, as it stands in a notebook; None for anything else."""
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "range":
        return range(*(ast.literal_eval(x) for x in node.args))
    return {k.__name__: k for k in (int, bool, float, str)}.get(getattr(node, "id", ""))


def literal(path: Path) -> str:
    """Path for papermill, which would otherwise fill in what stands between braces."""
    return str(path).replace("{", "{{").replace("}", "}}")
