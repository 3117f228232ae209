"""Guards for the collision shapes of a URDF, each in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.robot.urdf_numbers import numbers

SIZES = {"box": (("size", 3),), "sphere": (("radius", 1),), "cylinder": (("radius", 1), ("length", 1)),
         "capsule": (("radius", 1), ("length", 1))}  # fmt: skip


def shape_faults(root: ET.Element, where: str) -> Iterator[str]:
    """Sizes that no shape has, places that are no numbers, meshes without a file."""
    for link in root.findall("link"):
        at = f"{where}: link {link.get('name')!r}"
        for collision in link.findall("collision"):
            origin, geometry = collision.find("origin"), collision.find("geometry")
            for key in ("xyz", "rpy"):
                text = None if origin is None else origin.get(key)
                if text is not None and numbers(text, 3) is None:
                    yield f"{at}: collision origin {key} = {text!r} must be three finite numbers"
            for shape in () if geometry is None else geometry:
                yield from _sizes(shape, at)


def _sizes(shape: ET.Element, at: str) -> Iterator[str]:
    for key, count in SIZES.get(shape.tag, ()):
        values = numbers(shape.get(key), count)
        if values is None or np.any(values <= 0):
            wanted = "three positive numbers" if count == 3 else "a positive number"
            yield f"{at}: {shape.tag} {key} = {shape.get(key)!r} must be {wanted} of m"
    if shape.tag == "mesh":
        if not shape.get("filename"):
            yield f"{at}: a collision mesh has no filename; add it, or remove the shape"
        if shape.get("scale") is not None and numbers(shape.get("scale"), 3) is None:
            yield f"{at}: mesh scale = {shape.get('scale')!r} must be three finite numbers"
