"""A robot's TOML file: its entries read, each checked, each refused in one sentence; and a new one from a template."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jumplab.errors import RobotError

ROLES = ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")
LEG = ROLES[:3]
_REQUIRED = object()


def read_toml(text: str, where: str) -> dict:
    """The file as nested tables."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise RobotError(f"{where}: not a TOML file: {e}") from e


def entry(
    config: dict, *path: str, kind: type = float, count: int | None = None, default: Any = _REQUIRED
) -> float | str | list:
    """One checked entry of the configuration: a finite number or a text, or ``count`` of them.

    Raises :class:`RobotError` if it is of another kind, or missing without a ``default``.
    """
    where, value = ".".join(path), config
    for key in path:
        if not isinstance(value, dict) or key not in value:
            if default is not _REQUIRED:
                return default
            raise RobotError(f"robot configuration: the entry {where!r} is missing")
        value = value[key]
    items, numbers = value if count else [value], kind is float
    good = isinstance(items, list) and len(items) == (count or 1)
    good = good and all(isinstance(x, (int, float) if numbers else str) and not isinstance(x, bool) for x in items)
    if not good or (numbers and not np.all(np.isfinite(items))):
        many, wanted = f"{count} of " if count else "", "a finite number" if numbers else "a text"
        raise RobotError(f"robot configuration: {where!r} = {value!r}, must be {many}{wanted}")
    clean = [kind(x) for x in items]
    return clean if count else clean[0]


def table(config: dict, name: str) -> dict:
    """A table of the configuration, empty where it is missing."""
    value = config.get(name, {})
    if not isinstance(value, dict):
        raise RobotError(f"robot configuration: {name!r} = {value!r} must be a table [{name}]")
    return value


def roles_table(config: dict) -> dict[str, tuple[str, ...]]:
    """role -> (left, right) joint names; an empty list for the shoulder holds the arms, which is told as ()."""
    joints = {}
    for role in ROLES:
        held = role == "shoulder_pitch" and table(config, "joints").get(role) == []
        joints[role] = () if held else tuple(entry(config, "joints", role, kind=str, count=2))
    return joints


def filled(template: str, **values: Any) -> str:
    """A template of this folder with its fields filled in."""
    return Path(__file__).with_name(template).read_text(encoding="utf-8").format(**values)


def texts(values: Sequence[str]) -> str:
    """An array of texts, the same in TOML as in JSON."""
    return json.dumps(values, ensure_ascii=False)
