"""Conversion of the arguments of public functions, in one way, by their annotations.

Real numbers are those of Python and NumPy, and finite ones where nothing else is said; truth
values, complex numbers and texts are none. Other values are refused (:class:`InputError`) in one
sentence, before anything is done with them.
"""

from __future__ import annotations

import ast
import inspect
import math
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from jumplab.errors import InputError, as_path, quoted

if TYPE_CHECKING:  # help of a command is there before NumPy is
    import numpy as np

F = TypeVar("F", bound=Callable)
FLAGS = "bool", "bool_"
UNKNOWN = inspect.Parameter.empty  # an annotation that cannot be checked


def real(value: Any, what: str, unit: str = "") -> float:
    """A finite real number; raises :class:`InputError`, which calls it ``what``, in ``unit``."""
    if type(value).__name__ == "ndarray" and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool) or not isinstance(value, Real):
        raise InputError(
            f"{what} must be a number{f' in {unit}' * bool(unit)}, got {quoted(value)}"
        )
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{what} must be finite, got {quoted(value)}")
    return number


def shaped(value: Any, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    """An array of this ``shape``, such as (None, 3) for any number of rows; raises
    :class:`InputError`, which calls it ``what``.
    """
    array = _array(value, what)
    fits = array.ndim == len(shape) and all(
        wanted in (None, n) for wanted, n in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind == "U":
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise InputError(f"{what} must have the shape ({wanted}), got {quoted(value)}")
    return array.astype(float)


def checked(of: F) -> F:
    """The same function, or class with its constructor and public methods, whose arguments are
    converted by their annotations.

    Sequences and mappings are looked into. Parameters without an annotation, or with one of which
    nothing is known (``Any``), are left alone. Arguments that are missing, or that nobody takes,
    are refused as well (:class:`InputError`).
    """
    if not isinstance(of, type):
        return _checking(of)
    for name, member in list(vars(of).items()):
        inner = getattr(member, "__func__", member)  # of a class's or a static method
        if not inspect.isfunction(inner) or (name.startswith("_") and name != "__init__"):
            continue
        method = _checking(inner)
        setattr(of, name, method if member is inner else type(member)(method))
    return of


def _checking(function: F) -> F:
    signature = inspect.signature(function)
    parameters = signature.parameters
    called = function.__qualname__.removesuffix(".__init__")
    hints = {}  # known once the function is called, after all imports

    @wraps(function)
    def checking(*args: Any, **options: Any) -> Any:
        if not hints:
            hints.update({k: _hint(x.annotation, function) for k, x in parameters.items()})
        try:
            given = signature.bind(*args, **options)
        except TypeError as e:
            names = ", ".join(name for name in parameters if name not in ("self", "cls"))
            raise InputError(f"{called}: {e}; it takes {names or 'nothing'}") from None
        for name, value in given.arguments.items():
            parameter = parameters[name]
            hint = hints[name]
            default = parameter.default
            if parameter.kind is parameter.VAR_KEYWORD:
                given.arguments[name] = {k: fitting(x, hint, k) for k, x in value.items()}
            elif parameter.kind is parameter.VAR_POSITIONAL:
                given.arguments[name] = tuple(fitting(x, hint, name) for x in value)
            elif value is not default and not (isinstance(value, float) and value == default):
                given.arguments[name] = fitting(value, hint, name)
        return function(*given.args, **given.kwargs)

    return checking


def _hint(annotation: Any, function: Callable) -> Any:
    """An annotation as an object; :data:`UNKNOWN` if its names are not to be had at run time."""
    if not isinstance(annotation, str):
        return annotation
    module = sys.modules[inspect.unwrap(function).__module__]
    with suppress(NameError):
        return eval(annotation, vars(module))  # of this package's own sources
    with suppress(NameError, ImportError):
        return eval(annotation, _with_types(module))
    return UNKNOWN


@cache
def _with_types(module: types.ModuleType) -> dict[str, Any]:
    """A module's names, and those that it imports for type checkers alone."""
    out = dict(vars(module))
    for block in ast.parse(inspect.getsource(module)).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(block.body, []), module.__name__, "exec"), out)
    return out


def fitting(value: Any, hint: Any, what: str) -> Any:
    """A value as its ``hint`` has it; raises :class:`InputError`, which calls it ``what``."""
    if hint is UNKNOWN or hint is Any:
        return value
    if hint in SIMPLE:
        return SIMPLE[hint](value, what)
    if getattr(hint, "__name__", "") == "ndarray":
        return _array(value, what)
    if hint is getattr(sys.modules.get("numpy.typing"), "ArrayLike", UNKNOWN):
        return value if isinstance(value, Real) else _array(value, what)
    origin = typing.get_origin(hint)
    inner = typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return _one_of(value, inner, what)
    if origin is tuple and inner[-1] is not ...:
        items = list(_items(value, what))
        if len(items) != len(inner):
            raise InputError(f"{what} must have {len(inner)} entries, got {quoted(value)}")
        return tuple(
            fitting(x, h, f"an entry of {what}") for x, h in zip(items, inner, strict=True)
        )
    if origin is not None and issubclass(origin, Mapping):
        _of(value, Mapping, what, "a mapping")
        key, item = inner
        return {
            fitting(k, key, f"a name in {what}"): fitting(x, item, f"{what} of {quoted(k)}")
            for k, x in value.items()
        }
    if origin is not None and origin is not type and issubclass(origin, Iterable):
        items = [fitting(x, inner[0], f"an entry of {what}") for x in _items(value, what)]
        return items if origin is list else tuple(items)
    if isinstance(hint, type):
        with suppress(TypeError):  # a protocol that is not for run time
            return _of(value, hint, what, f"a {hint.__name__}")
    return value


def _one_of(value: Any, hints: tuple, what: str) -> Any:
    if Any in hints:
        return value
    if Path in hints and isinstance(value, str):
        return str(as_path(value, what)) if value else value
    for hint in hints:
        if isinstance(hint, type) and hint not in SIMPLE and isinstance(value, hint):
            return value
    wanted = []
    for hint in hints:
        try:
            return fitting(value, hint, what)
        except InputError as e:
            wanted.append(str(e))
    raise InputError(next((w for w in wanted if "must be None" not in w), wanted[0]))


def _of(value: Any, kind: type, what: str, words: str) -> Any:
    if not isinstance(value, kind):
        raise InputError(f"{what} must be {words}, got {quoted(value)}")
    return value


def _whole(value: Any, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise InputError(f"{what} must be a whole number, got {quoted(value)}")
    return int(value)


def _flag(value: Any, what: str) -> bool:
    if type(value).__name__ not in FLAGS:
        raise InputError(f"{what} must be True or False, got {quoted(value)}")
    return bool(value)


def _array(value: Any, what: str) -> np.ndarray:
    import numpy as np

    try:
        array = np.asarray(value)
    except ValueError:
        array = np.array(None)
    texts = array is value and array.dtype.kind == "U"  # names, of phases or joints
    if (not texts and array.dtype.kind not in "fiu") or array.ndim == 0:
        raise InputError(f"{what} must be an array of numbers, got {quoted(value)}")
    return array


def _items(value: Any, what: str) -> Iterable:
    """Entries of what is a sequence; a text or a mapping is none."""
    whole = isinstance(value, str | bytes | Mapping) or getattr(value, "ndim", 1) == 0
    if whole or not isinstance(value, Iterable):
        raise InputError(f"{what} must be a sequence, got {quoted(value)}")
    return value


SIMPLE = {
    float: real,
    int: _whole,
    bool: _flag,
    str: lambda value, what: _of(value, str, what, "a text"),
    Path: as_path,
    types.NoneType: lambda value, what: _of(value, types.NoneType, what, "None"),
}
