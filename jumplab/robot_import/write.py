"""Writers of URDF elements, of numbers with twelve digits, and words for names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from jumplab.forms import toml
from jumplab.robot.contact import shifted

MOST_NAMES = 6  # that a sentence lists
HERE = pin.SE3.Identity()


def add(parent: ET.Element, tag: str, **values: Any) -> ET.Element:
    """An element below ``parent``; attributes are texts, numbers, or arrays (n,)."""
    for key, value in values.items():
        if not isinstance(value, str):
            values[key] = " ".join(f"{x:.12g}" for x in 0.0 + np.atleast_1d(value))
    return ET.SubElement(parent, tag, values)


def add_origin(parent: ET.Element, place: pin.SE3) -> None:
    """Add the place of an element [m, rad]."""
    add(parent, "origin", xyz=place.translation, rpy=pin.rpy.matrixToRpy(place.rotation))


def add_joint(
    robot: ET.Element,
    name: str,
    kind: str,
    ends: tuple[str, str],
    place: pin.SE3 | None = None,
    axis: np.ndarray | None = None,
    limits: Mapping[str, float] | None = None,
) -> ET.Element:
    """A joint between two links, ``place`` of the child in the parent; if it moves, its
    ``axis`` (3,) and limits [rad, N m, rad/s].
    """
    joint = add(robot, "joint", name=name, type=kind)
    add(joint, "parent", link=ends[0])
    add(joint, "child", link=ends[1])
    if place is not None:
        add_origin(joint, place)
    if axis is not None:
        add(joint, "axis", xyz=axis)
        add(joint, "limit", **limits)
    return joint


def add_link(robot: ET.Element, name: str, inertia: pin.Inertia) -> ET.Element:
    """A link with its inertia, in its own frame [kg, m, kg m^2]."""
    link = add(robot, "link", name=name)
    inertial = add(link, "inertial")
    add_origin(inertial, shifted(inertia.lever))
    add(inertial, "mass", value=inertia.mass)
    m = np.where(np.abs(inertia.inertia) < 1e-15, 0.0, inertia.inertia)
    ends = zip(*np.triu_indices(3), strict=True)
    add(inertial, "inertia", **{f"i{'xyz'[i]}{'xyz'[k]}": m[i, k] for i, k in ends})
    return link


def listed(names: Iterable[Any]) -> str:
    """Names, or numbers, in quotes for a sentence, the first of many."""
    quoted = [*map(repr, names)]
    more = len(quoted) - MOST_NAMES
    return ", ".join(quoted[:MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


def key(name: str) -> str:
    """A name as a key of a TOML file: bare if it can be."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml(name)
