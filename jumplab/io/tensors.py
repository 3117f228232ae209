"""Files of ``torch.save``: a dictionary of arrays and numbers, written and read without PyTorch.

Such a file is a zip of a pickle and of each array's bytes. Reading runs nothing that is in it.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np

from jumplab import reading

REBUILD = ("torch._utils", "_rebuild_tensor_v2")
STORAGES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "BoolStorage": "|b1",
}
INDEX = "/data.pkl"


def _pickled(value: Any) -> bytes:
    """A plain value without head and end of its pickle."""
    return pickle.dumps(value, protocol=2)[2:-1]


def _named(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode()


def _tuple(*parts: bytes) -> bytes:
    return pickle.MARK + b"".join(parts) + pickle.TUPLE


def _tensor(array: np.ndarray, key: str) -> bytes:
    kinds = {np.dtype(kind): name for name, kind in STORAGES.items()}
    storage = _named("torch", kinds[array.dtype])
    storage = _tuple(
        _pickled("storage"), storage, _pickled(key), _pickled("cpu"), _pickled(array.size)
    )
    strides = tuple(stride // array.itemsize for stride in array.strides)
    hooks = _named("collections", "OrderedDict") + pickle.EMPTY_TUPLE + pickle.REDUCE
    shape = b"".join(_pickled(x) for x in (0, array.shape, strides, False))
    return _named(*REBUILD) + _tuple(storage + pickle.BINPERSID, shape, hooks) + pickle.REDUCE


def tensor_file(content: Mapping[str, Any]) -> bytes:
    """Bytes of a file from which ``torch.load`` makes a dictionary: arrays become tensors."""
    index = pickle.PROTO + b"\x02" + pickle.EMPTY_DICT + pickle.MARK
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for key, (name, value) in enumerate(content.items()):
            index += _pickled(name)
            if isinstance(value, np.ndarray):
                array = np.ascontiguousarray(value)
                index += _tensor(array, str(key))
                file.writestr(f"archive/data/{key}", array.tobytes())
            else:
                index += _pickled(value)
        file.writestr(f"archive{INDEX}", index + pickle.SETITEMS + pickle.STOP)
        file.writestr("archive/byteorder", "little")
        file.writestr("archive/version", "3\n")
    return buffer.getvalue()


class _Reader(pickle.Unpickler):
    """Makes arrays of tensors, and refuses to name or call anything else."""

    def __init__(self, file: zipfile.ZipFile, index: str):
        super().__init__(io.BytesIO(file.read(index)))
        self._file = file
        self._folder = index.removesuffix(INDEX)

    def find_class(self, module: str, name: str) -> Any:
        """An allowed one; raises for others."""
        if (module, name) == REBUILD:
            return _rebuilt
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in STORAGES:
            return np.dtype(STORAGES[name])
        raise pickle.UnpicklingError(f"it names {module}.{name}, which could run code")

    def persistent_load(self, pid: Any) -> np.ndarray:
        """The numbers of a tensor."""
        _, kind, key, _, _ = pid
        return np.frombuffer(self._file.read(f"{self._folder}/data/{key}"), kind)


def _rebuilt(numbers: np.ndarray, first: int, shape: tuple, strides: tuple, *rest: Any) -> Any:
    count = math.prod(shape)
    if count == 0:
        return np.empty(shape, numbers.dtype)
    # no copies of one number, and no steps for whose sums NumPy's own check is too narrow
    if max([count, *map(abs, strides)]) > len(numbers):
        raise ValueError(f"a tensor of shape {shape} does not fit its numbers")
    size = numbers.itemsize
    steps = [size * step for step in strides]
    return np.ndarray(shape, numbers.dtype, numbers, size * first, steps).copy()


def read_tensors(raw: bytes) -> Any | None:
    """Content of a file by ``torch.save``, tensors as arrays; None of other zip files.

    Raises :class:`pickle.UnpicklingError` if the content is no plain data.
    """
    with zipfile.ZipFile(io.BytesIO(raw)) as file:
        names = [name for name in file.namelist() if name.endswith(INDEX)]
        if not names:
            return None
        unpacked = sum(member.file_size for member in file.infolist())
        if unpacked > reading.MOST_UNPACKED_BYTES:
            raise ValueError(f"{unpacked} bytes are too many")
        return _Reader(file, names[0]).load()
