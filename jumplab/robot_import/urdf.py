"""From a path to XML that is worth reading: what is refused before anything is parsed as a robot.

The parsers of Pinocchio and PyBullet print to the console, guess, or return an empty robot where a file is cut short,
is a web page, or is not a URDF at all. Here each of these is said in one sentence.
"""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from jumplab.errors import RobotError

MAX_BYTES = 20_000_000  # the largest published URDF is under 1 MB; meshes do not belong here
PACKAGE = "example-robot-data"  # the optional package of published robots (extra "robots")
PACKAGE_FOLDER = "cmeel.prefix/share/example-robot-data/robots"
ROOTS = {
    "sdf": "an SDF file, not a URDF",
    "mujoco": "a MuJoCo model, not a URDF",
    "COLLADA": "a COLLADA mesh, not a URDF",
    "html": "a web page (HTML), not a URDF",
}


def numbers(text: str | None, count: int) -> np.ndarray | None:
    """``count`` finite numbers of an attribute, or None."""
    try:
        values = np.array([float(x) for x in (text or "").split()])
    except ValueError:
        return None
    return values if len(values) == count and np.all(np.isfinite(values)) else None


def locate(name: str, beside: Path) -> Path:
    """Path of a URDF: ``example-robot-data:folder/file.urdf``, or a path relative to the folder ``beside``."""
    package, colon, inside = name.partition(":")
    if not (colon and package == PACKAGE):
        return beside / name
    if not have_published():
        said = f"{name}: the package {PACKAGE} with the published robots is not installed"
        raise RobotError(f"{said}; pip install 'jumplab[robots]'")
    return Path(str(metadata.distribution(PACKAGE).locate_file(f"{PACKAGE_FOLDER}/{inside}")))


def have_published() -> bool:
    """True if the package with the published robots is installed."""
    return any(metadata.distributions(name=PACKAGE))


def read_urdf(path: str | Path) -> str:
    """The text of a URDF file. Raises :class:`RobotError` if it cannot be one."""
    path = Path(path)
    try:
        if path.is_dir():
            raise RobotError(f"{path}: is a folder; name the URDF file inside it")
        if (size := path.stat().st_size) > MAX_BYTES:
            most = f"a URDF has at most {MAX_BYTES / 1e6:.0f}; name the URDF, not a mesh"
            raise RobotError(f"{path}: has {size / 1e6:.0f} MB, {most}")
        return decode(path.read_bytes(), str(path))
    except FileNotFoundError:
        raise RobotError(f"{path}: there is no such file; give the path of a URDF") from None
    except (OSError, ValueError) as e:
        raise RobotError(f"{path}: cannot be read ({type(e).__name__}); give the path of a readable URDF") from e


def decode(raw: bytes, where: str) -> str:
    """Bytes as the text of a URDF; refuses what is no text, or text of another kind."""
    if not raw.strip():
        raise RobotError(f"{where}: the file is empty (0 of {len(raw)} bytes are text); copy or download it again")
    if raw[:2] in (b"\x1f\x8b", b"PK"):
        raise RobotError(f"{where}: is a compressed archive, not a URDF; unpack it first")
    try:
        text, at = raw.decode("utf-8-sig"), raw.find(b"\0")
    except UnicodeDecodeError as e:
        text, at = "", e.start
    if at >= 0:
        raise RobotError(f"{where}: is binary (byte {at} is no UTF-8 text); a URDF is an XML text")
    if text.startswith("version https://git-lfs.github.com/spec"):
        raise RobotError(f"{where}: is a Git LFS pointer of {len(raw)} bytes, not the file itself; run 'git lfs pull'")
    return text


def parse(text: str, where: str) -> ET.Element:
    """Root element of a URDF's text. Raises :class:`RobotError` with the place of the fault."""
    if re.match(r"\s*<(!doctype\s+html|html)", text, re.IGNORECASE):
        raise RobotError(f"{where}: is {ROOTS['html']}; download the raw file")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(f"{where}: declares a DOCTYPE or entities, which can expand without limit; remove them")
    xacro = f"{where}: is a xacro template; expand it first: 'xacro robot.xacro > robot.urdf'"
    try:
        root = ET.fromstring(text)
    except ET.ParseError as e:
        line, column = e.position
        said = str(e).partition(":")[0]
        if "unbound prefix" in said and "xacro:" in text:
            raise RobotError(xacro) from None
        ends = text.rstrip().endswith("</robot>")
        kind = "is not well-formed XML" if ends else "ends before </robot>; it is cut short or is no URDF"
        raise RobotError(f"{where}: line {line}, column {column}: {kind} ({said})") from None
    # a "${...}" in a simulator's plug-in does no harm, in a link or a joint it was meant as a number
    parts = (e for kind in ("link", "joint") for part in root.findall(kind) for e in part.iter())
    if any("xacro" in str(e.tag) for e in root.iter()) or any("${" in v for e in parts for v in e.attrib.values()):
        raise RobotError(xacro)
    tag = str(root.tag).rpartition("}")[2]
    if tag != "robot":
        raise RobotError(f"{where}: the root element is <{tag}>, {ROOTS.get(tag, 'a URDF begins with <robot>')}")
    return root
