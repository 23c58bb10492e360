"""Tar shards in webdataset's form, each with an index for random access.

A shard ``000000.tar`` holds ``KEY.npz`` (a training record) and ``KEY.json`` (where it comes
from) for every key; ``000000.json`` beside it says where each record lies. The index is written
first and the shard appears whole, so a shard that exists is complete.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

import webdataset

from cvthead.files import atomic_path, write_file
from cvthead.training.records import index_of


def write_shard(shard: Path, records: Mapping[str, tuple[Path, Mapping[str, Any]]]) -> None:
    """Pack records.

    Args:
        shard: the .tar file; replaced when there.
        records: by key, the .npz file and the contents of the JSON beside it, which must hold
            ``frames``.

    Raises:
        InputError: the shard cannot be written.
    """
    with atomic_path(shard) as temporary:
        # Without a time, the same records make the same bytes.
        with webdataset.TarWriter(str(temporary), mtime=0, user="", group="") as tar:
            for key, (file, facts) in records.items():
                tar.write({"__key__": key, "npz": file.read_bytes(), "json": dict(facts)})
        frames = {key: facts["frames"] for key, (_, facts) in records.items()}
        write_file(index_of(shard), json.dumps(index(temporary, frames), indent=1).encode())


def index(shard: Path, frames: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """Place and size of each record in a shard, in bytes, and its number of frames."""
    found = {}
    with tarfile.open(shard) as tar:
        for member in tar:
            key, suffix = PurePath(member.name).stem, PurePath(member.name).suffix
            if suffix == ".npz":
                place = {"offset": member.offset_data, "size": member.size}
                found[key] = place | {"frames": frames[key]}
    return found
