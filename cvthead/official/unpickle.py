"""Reads pickles of NumPy arrays, SciPy sparse matrices and chumpy arrays without running them.

A pickle is a program: it may call any function it names. Here it may only name the handful of
types below, each of which is replaced by an inert record that keeps what was stored. The arrays
are built from the records afterwards, so no unpickling code of NumPy, SciPy or chumpy runs.
"""

from __future__ import annotations

import pickle
import re
import struct
from collections import OrderedDict
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix

from cvthead.errors import AssetError

HINT = "use the files as their authors publish them"
# Numbers of 1 to 8 bytes; objects, strings and records do not occur.
NUMBER = re.compile(r"[<>|=]?[biuf][1248]")
# What a damaged or crafted pickle makes the standard library or NumPy raise.
DAMAGE = (
    pickle.UnpicklingError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    EOFError,
    OverflowError,
    MemoryError,
    RecursionError,
    ImportError,
    struct.error,
)


class Record:
    """What a pickle stored for one object: constructor arguments and state, never acted on."""

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments
        self.state: object = None

    def __setstate__(self, state: object) -> None:
        self.state = state


class DtypeRecord(Record):
    """Stands for ``numpy.dtype``: name, then byte order in the state."""

    def dtype(self) -> np.dtype[Any]:
        name = str(self.arguments[0])
        if not NUMBER.fullmatch(name):
            raise ValueError(f"an array of type {name!r}")
        state = self.state
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else "="
        return np.dtype(name).newbyteorder(cast(Any, _text(order)))


class ArrayRecord(Record):
    """Stands for ``numpy.ndarray``: version, shape, dtype, Fortran order and bytes."""

    def array(self) -> NDArray[Any]:
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            raise ValueError("an array without contents")
        _, shape, dtype, fortran, data = self.state
        if not isinstance(dtype, DtypeRecord):
            raise ValueError("an array without a type")
        flat = np.frombuffer(_bytes(data), dtype.dtype())
        return flat.reshape(tuple(shape), order="F" if fortran else "C").copy()


class SparseRecord(Record):
    """Stands for SciPy's compressed matrices: their attributes."""

    kind: type[csc_matrix] | type[csr_matrix] = csc_matrix

    def matrix(self) -> csc_matrix:
        if not isinstance(self.state, dict):
            raise ValueError("a sparse matrix without contents")
        shape = self.state["_shape"]
        parts = tuple(_plain(self.state[name]) for name in ("data", "indices", "indptr"))
        result = self.kind(parts, shape=tuple(int(n) for n in shape))
        result.check_format(full_check=True)
        return result.tocsc()


class RowRecord(SparseRecord):
    kind = csr_matrix


class ChumpyRecord(Record):
    """Stands for ``chumpy.ch.Ch``, whose value is the array ``x``."""

    def array(self) -> object:
        if not isinstance(self.state, dict) or "x" not in self.state:
            raise ValueError("a chumpy object that is no plain array")
        return _plain(self.state["x"])


class Ignored(Record):
    """Stands for a type whose contents are not needed."""


def _new_record(kind: type[Record], *arguments: object) -> Record:
    """Stands for ``copyreg._reconstructor`` and NumPy's ``_reconstruct``."""
    if not (isinstance(kind, type) and issubclass(kind, Record)):
        raise pickle.UnpicklingError("an object of another type")
    return kind()


def _scalar(dtype: DtypeRecord, data: object) -> Any:
    """Stands for NumPy's ``scalar``."""
    return np.frombuffer(_bytes(data), dtype.dtype())[0]


def _frombuffer(data: object, dtype: DtypeRecord, shape: object, order: str) -> ArrayRecord:
    """Stands for NumPy's ``_frombuffer``, by which protocol 5 writes arrays."""
    array = ArrayRecord()
    array.state = (1, shape, dtype, order == "F", data)
    return array


def _encoded(text: str, encoding: str) -> bytes:
    """Stands for ``_codecs.encode``, by which Python 3 writes bytes in old protocols."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes in {encoding!r}")
    return text.encode("latin-1")


ALLOWED: dict[str, Callable[..., object]] = {
    "numpy.ndarray": ArrayRecord,
    "numpy.dtype": DtypeRecord,
    "scipy.sparse.csc_matrix": SparseRecord,
    "scipy.sparse.csr_matrix": RowRecord,
    "chumpy.ch.Ch": ChumpyRecord,
    "copyreg._reconstructor": _new_record,
    "copy_reg._reconstructor": _new_record,
    "_codecs.encode": _encoded,
    "collections.OrderedDict": OrderedDict,
    # The third argument of copyreg._reconstructor; an instance of it holds nothing.
    "builtins.object": object,
    "__builtin__.object": object,
    # Chumpy keeps a set of names beside each array.
    "builtins.set": Ignored,
    "__builtin__.set": Ignored,
}
for _core in ("numpy.core.multiarray", "numpy._core.multiarray"):
    ALLOWED[f"{_core}._reconstruct"] = _new_record
    ALLOWED[f"{_core}.scalar"] = _scalar
for _core in ("numpy.core.numeric", "numpy._core.numeric"):
    ALLOWED[f"{_core}._frombuffer"] = _frombuffer
for _module in ("csc", "_csc"):
    ALLOWED[f"scipy.sparse.{_module}.csc_matrix"] = SparseRecord
for _module in ("csr", "_csr"):
    ALLOWED[f"scipy.sparse.{_module}.csr_matrix"] = RowRecord


class RestrictedUnpickler(pickle.Unpickler):
    """Resolves the names of ALLOWED and of ``ignored``, and refuses every other."""

    def __init__(self, file: BinaryIO, ignored: frozenset[str]) -> None:
        # Python 2 wrote byte strings without saying so; latin-1 keeps every byte.
        super().__init__(file, encoding="latin-1")
        self.ignored = ignored

    def find_class(self, module_name: str, global_name: str) -> Any:
        name = f"{module_name}.{global_name}"
        if name in ALLOWED:
            return ALLOWED[name]
        if name in self.ignored:
            return Ignored
        raise pickle.UnpicklingError(f"it names {name}, which is not an array type")

    def persistent_load(self, pid: object) -> Any:
        raise pickle.UnpicklingError("it refers to an object outside the file")


def load_pickle(path: Path, *, ignored: frozenset[str] = frozenset()) -> Any:
    """Plain containers, numbers, strings, arrays and sparse matrices of a pickle file.

    Args:
        path: written by Python 2 or 3.
        ignored: further ``module.name`` that may occur; what they stand for becomes ``None``.

    Returns:
        The stored object; chumpy arrays as NumPy arrays, sparse matrices as ``csc_matrix``.

    Raises:
        AssetError: unreadable, damaged, or it names anything else.
    """
    try:
        with path.open("rb") as file:
            return _read(file, ignored)
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror}", hint=HINT) from error
    except DAMAGE as error:
        raise AssetError(f"{path} is refused: {error}", hint=HINT) from error


def named_tables(path: Path, stored: object) -> dict[str, Any]:
    """The contents of a file that should hold tables by name.

    Raises:
        AssetError: it holds something else.
    """
    if not isinstance(stored, dict) or not all(isinstance(key, str) for key in stored):
        raise AssetError(f"{path} holds no named tables", hint=HINT)
    return stored


def load_npy(path: Path, *, ignored: frozenset[str] = frozenset()) -> Any:
    """The one object of an ``.npy`` file that holds an object array; as :func:`load_pickle`.

    Raises:
        AssetError: as :func:`load_pickle`, or not such a file.
    """
    try:
        with path.open("rb") as file:
            version = npy_format.read_magic(file)
            read_header = {
                (1, 0): npy_format.read_array_header_1_0,
                (2, 0): npy_format.read_array_header_2_0,
            }[version]
            shape, _, dtype = read_header(file)
            if shape != () or not dtype.hasobject:
                raise ValueError("it holds no single object")
            stored = _unpickled(BytesIO(file.read()), ignored)
        # The pickle is an object array, whose bytes are a list with the one object.
        if not isinstance(stored, ArrayRecord) or not isinstance(stored.state, tuple):
            raise ValueError("it holds no single object")
        (content,) = stored.state[4]
        return _plain(content)
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror}", hint=HINT) from error
    except DAMAGE as error:
        raise AssetError(f"{path} is refused: {error}", hint=HINT) from error


def _read(file: BinaryIO, ignored: frozenset[str]) -> Any:
    return _plain(_unpickled(file, ignored))


def _unpickled(file: BinaryIO, ignored: frozenset[str]) -> object:
    return RestrictedUnpickler(file, ignored).load()


def _plain(value: object) -> Any:
    """Records inside containers replaced by what they stand for."""
    if isinstance(value, Ignored):
        return None
    if isinstance(value, ArrayRecord | ChumpyRecord):
        return value.array()
    if isinstance(value, SparseRecord):
        return value.matrix()
    if isinstance(value, DtypeRecord):
        return value.dtype()
    if isinstance(value, dict):
        return {_key(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_plain(entry) for entry in value)
    if value is None or isinstance(value, bool | int | float | str | bytes | np.number):
        return value
    raise ValueError(f"an object of type {type(value).__name__}")


def _key(key: object) -> object:
    if isinstance(key, str | int):
        return key
    raise ValueError(f"a key of type {type(key).__name__}")


def _bytes(data: object) -> bytes:
    """Python 2's byte strings arrive as latin-1 text."""
    if isinstance(data, str):
        return data.encode("latin-1")
    if isinstance(data, bytes | bytearray):
        return bytes(data)
    raise ValueError("an array of objects")


def _text(value: object) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)
