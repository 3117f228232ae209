"""Places of the notebooks, and of the code beside them that runs and checks them."""

import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from jumplab.errors import InputError

PATTERN = "[0-9][0-9]_*.ipynb"
PACKAGE = Path(__file__).resolve().parent.parent
# beside the package (a checkout), else those that it was installed with
PLACES = [root / "notebooks" for root in (PACKAGE.parent, PACKAGE)]
_PAPER = next((place for place in PLACES if (place / "paper").is_dir()), PLACES[0])


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """The package's notebooks in their order: beside the package (a checkout), else those that it
    was installed with.

    ``names`` says which ones, by number or whole name ("02", "02_srmp"); all if empty. Raises
    InputError if there are none, or none of a name.
    """
    paths = next(filter(None, (sorted(place.glob(PATTERN)) for place in PLACES)), None)
    if paths is None:
        there = " nor in ".join(repr(str(place)) for place in PLACES)
        raise InputError(f"no notebooks in {there}; install jumplab again")
    named = {name: path for path in paths for name in (path.stem, path.stem[:2])}
    for name in names:
        if name not in named:
            there = ", ".join(path.stem for path in paths)
            raise InputError(f"no notebook {name!r}; there are {there}")
    return sorted({named[name] for name in names}) or paths


def paper(name: str) -> ModuleType:
    """A module of the folder ``paper`` beside the notebooks, by its name."""
    if str(_PAPER) not in sys.path:
        sys.path.append(str(_PAPER))
    return import_module(f"paper.{name}")


def beside(name: str, words: str) -> Callable[[Namespace], None]:
    """The command of a ``name`` that ``paper/commands.py`` does, and its help in ``words``."""

    def work(args: Namespace) -> None:
        getattr(paper("commands"), name)(args)

    work.__name__ = name
    work.__doc__ = words
    return work


def check_parameters(namespace: Mapping[str, Any]) -> None:
    """Refuse (:class:`InputError`) what the notebook with this ``globals()`` was given, if it
    cannot be meant; see ``check_parameters`` in ``paper/running.py``.
    """
    paper("running").check_parameters(namespace)
