"""Official files are read as data: arrays come out as they went in, programs are refused."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import made_official
import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix, csr_matrix

from cvthead.errors import AssetError
from cvthead.official import torch_files
from cvthead.official.unpickle import load_npy, load_pickle


class Call:
    """Pickles as a call of ``function``."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.function, self.arguments


def stored(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "file.pkl"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_matrices_come_back(protocol: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    matrix = csc_matrix((rng.random(4), ([0, 1, 2, 2], [3, 0, 1, 4])), shape=(3, 5))
    sent = {
        "floats": rng.random((3, 4)),
        "fortran": np.asfortranarray(rng.random((3, 4)).astype(np.float32)),
        "big": np.arange(6, dtype=">i4").reshape(2, 3),
        "unsigned": np.array([2**32 - 1, 0], np.uint32),
        "columns": matrix,
        "rows": csr_matrix(matrix),
        "nested": [{"a": (np.arange(3), "text", 1.5, None, True)}],
        "scalar": np.float64(0.25),
    }
    found = load_pickle(stored(tmp_path, pickle.dumps(sent, protocol=protocol)))
    for name in ("floats", "fortran", "big", "unsigned"):
        expected = sent[name]
        assert isinstance(expected, np.ndarray)
        assert found[name].dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        assert np.array_equal(found[name], expected)
    for name in ("columns", "rows"):
        assert isinstance(found[name], csc_matrix)
        assert np.array_equal(found[name].toarray(), matrix.toarray())
    assert np.array_equal(found["nested"][0]["a"][0], np.arange(3))
    assert found["nested"][0]["a"][1:] == ("text", 1.5, None, True)
    assert found["scalar"] == 0.25


def test_python_2_byte_strings(tmp_path: Path) -> None:
    """As Python 2 and old NumPy wrote FLAME: module names of then, bytes as plain strings."""
    values = np.array([1.5, -2.25, 1e300])
    pieces = [
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R",
        b"(K\x01K\x03\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R",
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89",
        b"U" + bytes([values.nbytes]) + struct.pack("<3d", *values) + b"tb.",
    ]
    assert np.array_equal(load_pickle(stored(tmp_path, b"".join(pieces))), values)


def test_chumpy_arrays_come_back_as_arrays(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((4, 3))
    with made_official.chumpy() as wrap:
        data = pickle.dumps({"v_template": wrap(values)}, protocol=2)
    assert np.array_equal(load_pickle(stored(tmp_path, data))["v_template"], values)


def gadgets() -> dict[str, bytes]:
    """Pickles that do something when they are loaded in the ordinary way."""
    mark = "touch REACHED"
    array = np.array([1.0])
    objects = np.array([Call(os.system, mark)], dtype=object)
    dump = pickle.dumps
    return {
        "os.system": dump(Call(os.system, mark)),
        "posix by name": b"cposix\nsystem\n(V" + mark.encode() + b"\ntR.",
        "eval": dump(Call(builtins.eval, f"__import__('os').system({mark!r})")),
        "getattr": dump(Call(getattr, array, "tofile")),
        "open": dump(Call(open, "REACHED", "w")),
        "import": dump(Call(__import__, "os")),
        "numpy.load": dump(Call(np.load, "x.npy", None, True)),
        "inside a list": dump([array, {"f": Call(os.system, mark)}]),
        "inside an object array": dump(objects),
        "object array, old protocol": dump(objects, protocol=2),
        "torch's own loader": b"ctorch.storage\n_load_from_bytes\n(C\x01xtR.",
        "a dotted name": b"\x80\x04\x8c\x05numpy\x8c\x0fndarray.tofile\n\x93.",
        "a method of an allowed type": b"\x80\x04\x8c\x0bcollections\x8c\x10OrderedDict.copy\x93.",
        "an extension code": b"\x80\x02\x82\x01.",
        "a persistent name": b"Pos.system\n.",
        "reconstructing a class": b"ccopyreg\n_reconstructor\n(c__builtin__\nobject\nc__builtin__\n"
        b"object\nNtR.",
        "a set": dump({1, 2}),
        "a function as data": b"c_codecs\nencode\n.",
        "a type as data": b"cnumpy\nndarray\n.",
        "bytes in another encoding": b"c_codecs\nencode\n(Vab\nVzip\ntR.",
    }


@pytest.mark.parametrize("name", gadgets())
def test_programs_are_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssetError, match="is refused"):
        load_pickle(stored(tmp_path, gadgets()[name]))
    assert [path.name for path in tmp_path.iterdir()] == ["file.pkl"]


def test_the_gadget_would_work_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the test above would prove nothing."""
    monkeypatch.chdir(tmp_path)
    pickle.loads(gadgets()["os.system"])
    assert (tmp_path / "REACHED").exists()


@pytest.mark.parametrize("cut", [0, 1, 20, 100, -1])
def test_truncated_pickles(cut: int, tmp_path: Path) -> None:
    data = pickle.dumps({"a": np.arange(50.0)}, protocol=2)
    with pytest.raises(AssetError):
        load_pickle(stored(tmp_path, data[:cut]))


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="cannot read"):
        load_pickle(tmp_path / "none.pkl")


def npy(content: object) -> bytes:
    out = io.BytesIO()
    np.save(out, np.array(content, dtype=object), allow_pickle=True)
    return out.getvalue()


def test_npy_with_tables(tmp_path: Path) -> None:
    path = stored(tmp_path, npy({"faces": np.arange(5), "unused": torch.zeros(3)}))
    with pytest.raises(AssetError, match="torch"):
        load_npy(path)
    names = frozenset({"torch._utils._rebuild_tensor_v2", "torch.storage._load_from_bytes"})
    found = load_npy(path, ignored=names)
    assert np.array_equal(found["faces"], np.arange(5))
    assert found["unused"] is None


@pytest.mark.parametrize(
    "data", [npy({"a": Call(os.system, "touch REACHED")}), npy([1, 2]), b"\x93NUMPY", b""]
)
def test_npy_refused(data: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssetError):
        load_npy(stored(tmp_path, data))
    assert not (tmp_path / "REACHED").exists()


@pytest.mark.parametrize("zipped", [True, False])
def test_torch_files(zipped: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    good, bad = tmp_path / "good.pt", tmp_path / "bad.pt"
    content = {"model": {"a": torch.ones(2)}, "loss": np.float64(0.5)}
    torch.save(content, good, _use_new_zipfile_serialization=zipped)
    assert torch_files.load_state(good, "model")["a"].tolist() == [1, 1]
    assert torch_files.load(good)["loss"] == 0.5
    torch.save(content | {"x": Call(os.system, "touch REACHED")}, bad,
               _use_new_zipfile_serialization=zipped)  # fmt: skip
    with pytest.raises(AssetError, match=r"refused: it names \w+\.system"):
        torch_files.load(bad)
    assert not (tmp_path / "REACHED").exists()
    with pytest.raises(AssetError, match="no named tensors"):
        torch_files.load_state(good)
    with pytest.raises(AssetError, match="no tensor"):
        torch_files.load_tensor(good)
    good.write_bytes(good.read_bytes()[:-40])
    with pytest.raises(AssetError):
        torch_files.load(good)
