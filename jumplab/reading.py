"""The one way to read a file that others may have made, with its limits.

Only regular files are read (no device, pipe or folder, which may never end), none that is larger
than :data:`KINDS` allows, and nothing is unpacked or allocated before its header says that it
fits. Robots are named by the user, and may be links; a result folder holds none, see
:func:`below`.
"""

from __future__ import annotations

import io
import math
import os
import stat
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from xml.etree import ElementTree

from jumplab.errors import InputError

if TYPE_CHECKING:  # help of a command is there before NumPy is
    import numpy as np

LINE_BYTES = 20_000_000  # of a log, which is read line by line
MOST_UNPACKED_BYTES = 800_000_000  # of all arrays of a file together
MOST_ARRAYS = 1000  # in one file
MOST_TAGS = 100_000  # of an XML text; the largest published robot has some 5000
# elements of an MJCF that make copies or points: attributes that say how many, and the most
COPYING = {
    "replicate": ("count", 1000),
    "composite": ("count", 1000),
    "flexcomp": ("count", 1000),
    "hfield": ("nrow ncol", 4_000_000),
}
INCLUDING = ("include", "model")  # elements of an MJCF that name another one
# [bytes] of a file, by what it is: several times the largest that this package or a publisher of
# robots makes; in words; what to do
KINDS = {
    # MJCF and TOML as well; the largest published URDF is under 1 MB
    "robot": (20_000_000, "a URDF", "name the URDF, not a mesh"),
    "report": (100_000_000, "a report", "delete it, and make it again"),
    # packed; an atlas of 2500 nodes has some 30 MB
    "arrays": (200_000_000, "a file of arrays", "delete it, and make it again"),
    "clip": (200_000_000, "a motion clip", "give one clip, cut to what is wanted"),
    "log": (1_000_000_000, "a log", "choose another folder"),
}
# how what others may have made is opened: no link is followed, no pipe is waited for
SAFE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
# what reading a cut, altered or foreign file of arrays may raise
DAMAGE = (
    OSError,
    ValueError,
    TypeError,
    EOFError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


@contextmanager
def opened(
    path: str | Path, kind: str, *, error: type[InputError] = InputError, link: bool = True
) -> Iterator[BinaryIO]:
    """A regular file of a ``kind`` (one of :data:`KINDS`), open to be read.

    Raises ``error`` if it is no regular file, is too large, or is a symbolic link where no
    ``link`` is followed; OSError if the system refuses it.
    """
    if not link:
        refuse_link(path)
    flags = SAFE & ~os.O_NOFOLLOW if link else SAFE
    with os.fdopen(os.open(path, flags), "rb") as file:
        check(file, path, kind, error)
        yield file


def check(
    file: BinaryIO, path: str | Path, kind: str, error: type[InputError] = InputError
) -> None:
    """Raise ``error`` unless an open file is a regular one, and not larger than its ``kind`` is."""
    about = os.fstat(file.fileno())
    if not stat.S_ISREG(about.st_mode):
        raise error(f"{path}: is a pipe or a device; save it to a file first")
    most, what, remedy = KINDS[kind]
    if about.st_size > most:
        size = f"{about.st_size / 1e6:.0f} MB, {what} has at most {most / 1e6:.0f}"
        raise error(f"{path}: has {size}; {remedy}")


def content(
    path: str | Path, kind: str, *, error: type[InputError] = InputError, link: bool = True
) -> bytes:
    """All bytes of a file, see :func:`opened`."""
    with opened(path, kind, error=error, link=link) as file:
        return file.read(KINDS[kind][0])


def refuse_link(path: str | Path) -> None:
    """Raise :class:`InputError` if ``path`` itself is a symbolic link."""
    if os.path.islink(path):
        raise InputError(
            f"{str(path)!r} is a symbolic link, which no result folder holds; remove it"
        )


def xml(text: str | bytes, where: str, error: type[InputError] = InputError) -> ElementTree.Element:
    """Root element of an XML text; raises ``error`` for too many elements,
    :class:`xml.etree.ElementTree.ParseError` if it is none.
    """
    if (count := text.count("<" if isinstance(text, str) else b"<")) > MOST_TAGS:
        raise error(
            f"{where}: has {count} XML tags, a robot at most {MOST_TAGS}; give the file of a robot"
        )
    return ElementTree.fromstring(text)


def check_mjcf(
    path: Path, folder: Path, error: type[InputError] = InputError, seen: Collection[Path] = ()
) -> None:
    """Refuse (``error``) an MJCF file that makes more copies or points than a robot has, or
    includes what is no file of it; ``folder`` is that of the first file, ``seen`` are those before.

    MuJoCo itself has no such limits. Files that are no XML are left to it.
    """
    try:
        raw = content(path, "robot", error=error)
        try:
            root = xml(raw, path.name, error)
        except (ValueError, LookupError):  # an encoding that is not known here; its tags are ASCII
            root = xml(raw.decode("latin-1"), path.name, error)
    except (OSError, ElementTree.ParseError):
        return
    todo = [(root, 1)]
    for element, copies in todo:
        if element.tag in COPYING:
            names, most = COPYING[element.tag]
            words = " ".join(element.get(name, "") for name in names.split()).split()
            copies *= math.prod(int(x) for x in words if x.isdecimal())
            if copies > most:
                raise error(
                    f"{path.name}: <{element.tag}> makes {copies:.3g} copies or points, at "
                    f"most {most} are read; remove it, or ask for fewer"
                )
        todo += [(child, copies) for child in element]
        for beside in {folder, path.parent} if element.tag in INCLUDING else ():
            included = (beside / element.get("file", "")).resolve()
            if included not in seen:
                check_mjcf(included, folder, error, {*seen, included})


def require_private(path: str | Path, about: os.stat_result) -> None:
    """Raise :class:`InputError` unless this user owns a file or folder (its status is ``about``),
    and nobody else can write it.
    """
    if about.st_uid != os.geteuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise InputError(
            f"{path}: belongs to another user, or others can write it; delete it, or choose "
            "another folder"
        )


def below(folder: str | Path, *names: str) -> Path:
    """A path below a result folder, which itself may be a link; raises :class:`InputError` if a
    part of the way below it is one, since what it leads to is not the folder's.
    """
    path = Path(folder)
    for name in names:
        path = path / name
        refuse_link(path)
    return path


def arrays(raw: bytes) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name, none of objects; raises one of :data:`DAMAGE`.

    Every size is known from the headers, and checked, before anything is unpacked or allocated.
    """
    with zipfile.ZipFile(io.BytesIO(raw)) as file:
        members = file.infolist()
        unpacked = sum(member.file_size for member in members)
        if len(members) > MOST_ARRAYS or unpacked > MOST_UNPACKED_BYTES:
            raise ValueError(f"{len(members)} arrays of {unpacked} bytes are too many")
        return {m.filename.removesuffix(".npy"): _array(file.read(m)) for m in members}


def _array(raw: bytes) -> np.ndarray:
    """One array of a ``.npy`` file whose header says as much as follows it."""
    import numpy as np

    file = io.BytesIO(raw)
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, _, kind = read[version](file)
    count = math.prod(shape)
    if kind.hasobject or min(shape, default=0) < 0 or count > len(raw):
        raise ValueError(f"an array of kind {kind} and shape {shape} does not fit its file")
    if count * kind.itemsize != len(raw) - file.tell():
        raise ValueError(f"an array of {count * kind.itemsize} bytes has another number in it")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
