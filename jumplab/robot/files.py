"""The two files of a robot: which ones there are, their texts, and the entries of the TOML
file, each refused in one sentence.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from jumplab import reading
from jumplab.errors import RobotError, quoted

HERE = Path(__file__).parent
SHIPPED = {
    path.stem: path
    for path in (HERE / "bhr" / "bhr.toml", *sorted((HERE / "published").glob("*.toml")))
}
ROLES = ("hip_pitch", "knee", "ankle_pitch", "shoulder_pitch")
LEG = ROLES[:3]
# tables of [actuators], and what holds of a joint that they do not name
MOTORS = {
    "corner_speed_ratios": None,  # that of all joints
    "no_load_ratios": 1.0,
    "armature": 0.0,
    "friction": 0.0,
    "damping": 0.0,
}
STANCE = ("knee_rad", "trunk_pitch_rad", "shoulder_rad")
# what the TOML file of a robot holds: its tables and their entries; () for names of the robot
TABLES = {
    "name": None,
    "urdf": None,
    "joints": ROLES,
    "feet": ("links", "sole_x_m", "sole_y_m", "sole_z_m"),
    "stance": STANCE,
    "rest": (),
    "actuators": ("corner_speed_ratio", *MOTORS),
    "bus": ("power_w", "regeneration", "losses", "rms"),
    "published": ("trunk", "xyz_m", "rpy_rad", "urdf", "held"),
    "source": (),  # where the URDF came from; only the importer reads it
}
_REQUIRED = object()
DEEPEST = 100  # the parser takes memory by the square of the parts of a key
NESTED = re.compile(rf"(?:[^\s.=]{{1,64}}[ \t]*\.[ \t]*){{{DEEPEST}}}")


def files_of(name_or_path: str | Path) -> tuple[str, Path, str | None]:
    """A robot's URDF as its TOML file names it, the folder that it is named from, and the TOML's
    text; None for a bare URDF or MJCF, whatever it is called.

    Raises :class:`RobotError` if there is neither.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        raise RobotError(
            f"a robot must be a name or the path of a TOML file, got {quoted(name_or_path)}"
        )
    name = str(name_or_path)
    path = SHIPPED.get(name) or Path(name)
    if path.suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return path.name, path.parent, None
    try:
        raw = reading.content(path, "robot", error=RobotError)
    except (OSError, ValueError) as e:
        known = ", ".join(SHIPPED)
        short = name if len(name) < 80 else name[:77] + "..."
        raise RobotError(
            f"robot {short!r}: neither a shipped robot ({known}) nor a readable TOML file"
        ) from e
    if path.suffix.lower() != ".toml" and is_xml(raw):
        return path.name, path.parent, None
    text = toml_text(raw, str(path))
    urdf = read_toml(text, str(path)).get("urdf")
    if not isinstance(urdf, str):
        raise RobotError(
            f"{path}: the entry 'urdf' must name the URDF file beside it, got {urdf!r}"
        )
    return urdf, path.parent, text


def is_xml(raw: bytes) -> bool:
    """Whether bytes begin as an XML text does, in any encoding."""
    return raw[:256].replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n").startswith(b"<")


def toml_text(raw: bytes, where: str) -> str:
    """Bytes as the text of a TOML file, which is UTF-8 on every machine."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise RobotError(
            f"{where}: not a text file, byte {e.start} cannot be read as UTF-8; save it as UTF-8"
        ) from e


def read_text(path: Path) -> str:
    """The text of a URDF file. Raises :class:`RobotError` if it cannot be one."""
    try:
        if path.is_dir():
            raise RobotError(f"{path}: is a folder; name the URDF file inside it")
        return decode(reading.content(path, "robot", error=RobotError), str(path))
    except FileNotFoundError:
        raise RobotError(f"{path}: there is no such file; give the path of a URDF") from None
    except (OSError, ValueError) as e:
        raise RobotError(
            f"{path}: cannot be read ({type(e).__name__}); give the path of a readable URDF"
        ) from e


def _encoding(raw: bytes) -> str:
    """The encoding of an XML text: by its first bytes, else as it declares, else UTF-8."""
    marks = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}
    if (marked := marks.get(raw[:2])) is not None:
        return marked
    declared = re.match(
        rb"(?:\s|<!--.*?-->)*<\?xml[^>]*encoding\s*=\s*[\"']([\w.:-]+)", raw, re.DOTALL
    )
    name = declared[1].decode() if declared else "utf-8"
    return "utf-8-sig" if name.lower() in ("utf-8", "utf8") else name


def decode(raw: bytes, where: str) -> str:
    """Bytes as the text of a URDF, in the encoding that it declares; :class:`RobotError` for
    anything else.
    """
    if not raw.strip():
        raise RobotError(
            f"{where}: the file is empty (0 of {len(raw)} bytes are text); copy or download it "
            f"again"
        )
    if raw[:2] in (b"\x1f\x8b", b"PK"):
        raise RobotError(f"{where}: is a compressed archive, not a URDF; unpack it first")
    encoding = _encoding(raw)
    try:
        text = raw.decode(encoding)
        at = text.find("\0")
    except UnicodeDecodeError as e:
        if is_xml(raw) and b"\0" not in raw:
            name = encoding.removesuffix("-sig").upper()
            raise RobotError(
                f"{where}: byte {e.start} is no {name} text; save it as UTF-8, or declare its "
                f'encoding in the first line, such as <?xml version="1.0" encoding="ISO-8859-1"?>'
            ) from e
        at = e.start
    except LookupError:
        raise RobotError(
            f"{where}: declares the encoding {encoding!r}, which is unknown; save it as UTF-8"
        ) from None
    if at >= 0:
        raise RobotError(f"{where}: is binary (byte {at} is no UTF-8 text); a URDF is an XML text")
    if text.startswith("version https://git-lfs.github.com/spec"):
        raise RobotError(
            f"{where}: is a Git LFS pointer of {len(raw)} bytes, not the file itself; run 'git "
            f"lfs pull'"
        )
    return text


# entries of the TOML file
# -------------------------------------------------------------------------------------------
def read_toml(text: str, where: str) -> dict:
    """The file as nested tables; :class:`RobotError` (with the name ``where``) if it is none."""
    if NESTED.search(text):
        raise RobotError(
            f"{where}: a key has more than {DEEPEST} parts between dots; give the TOML file of a "
            f"robot"
        )
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as e:
        twice = "; put its lines into the one that is there" if "twice" in str(e) else ""
        raise RobotError(f"{where}: not a TOML file: {e}{twice}") from e


def entry(
    config: dict, *path: str, kind: type = float, count: int | None = None, default: Any = _REQUIRED
) -> Any:
    """One checked entry of the configuration: a finite number or a text, or ``count`` of them (a
    list).

    Raises :class:`RobotError` if it is of another kind, or missing without a ``default``.
    """
    where = ".".join(path)
    value = config
    for key in path:
        if not isinstance(value, dict) or key not in value:
            if default is not _REQUIRED:
                return default
            raise RobotError(f"robot configuration: the entry {where!r} is missing")
        value = value[key]
    items = value if count else [value]
    types, wanted = ((int, float), "a finite number") if kind is float else ((str,), "a text")
    good = isinstance(items, list) and len(items) == (count or 1)
    good = good and all(type(x) in types for x in items)
    if not good or (kind is float and not np.all(np.isfinite(items))):
        many = f"{count} of " if count else ""
        raise RobotError(f"robot configuration: {where!r} = {value!r}, must be {many}{wanted}")
    clean = [kind(x) for x in items]
    return clean if count else clean[0]


def check_entries(config: dict, known: Mapping[str, tuple[str, ...] | None]) -> None:
    """Refuse (:class:`RobotError`) tables and entries that nothing reads, such as misspelt ones.

    ``known`` are the entries of each table, as :data:`TABLES` has them.
    """
    for title, values in config.items():
        _check_name(title, known, "", "[{}]" if isinstance(values, dict) else "{!r}")
        for name in table(config, title) if known[title] else ():
            _check_name(name, known[title], f"[{title}] ", "{!r}")


def _check_name(name: str, known: Collection[str], where: str, shown: str) -> None:
    if name not in known:
        near = get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(known)}"
        raise RobotError(f"robot configuration: {where}{shown.format(name)} is unknown; {hint}")


def table(config: dict, name: str) -> dict:
    """A table of the configuration, {} where it is missing; :class:`RobotError` if it is none."""
    value = config.get(name, {})
    if not isinstance(value, dict):
        raise RobotError(f"robot configuration: {name!r} = {value!r} must be a table [{name}]")
    return value


def numbers(config: dict, *path: str) -> dict[str, float]:
    """A table, or one within another, of finite numbers by name; {} where it is missing."""
    rows = config
    for key in path:
        rows = table(rows, key)
    return {name: entry(config, *path, name) for name in rows}


def roles_table(config: dict) -> dict[str, tuple[str, ...]]:
    """role -> (left, right) joint names; () for a shoulder whose list is empty: held arms."""
    joints = {}
    for role in ROLES:
        held = role == "shoulder_pitch" and table(config, "joints").get(role) == []
        joints[role] = () if held else tuple(entry(config, "joints", role, kind=str, count=2))
    return joints
