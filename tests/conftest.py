"""Fixtures that several test files use."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from cvthead import Avatar, Pipeline
from cvthead.images import read_image
from cvthead.source import Source, cut_head, read_source

PORTRAIT = Path(__file__).parents[1] / "examples" / "astronaut.png"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Reference data beside the repository; CVTHEAD_SHARED overrides the place."""
    default = Path(__file__).parents[2] / "shared"
    path = Path(os.environ.get("CVTHEAD_SHARED", default))
    if not path.is_dir():
        pytest.skip(f"no reference data at {path}; set CVTHEAD_SHARED")
    return path


@pytest.fixture(scope="session")
def pipeline() -> Pipeline:
    """The packaged open preset."""
    return Pipeline.load()


@pytest.fixture(scope="session")
def encoded(pipeline: Pipeline) -> tuple[Avatar, Source]:
    """Read in one go: late in a process, tracked coefficients and masks may differ by roundings
    from those of its start, and that decides how a few points of the hair are fitted."""
    image = read_image(PORTRAIT)
    crop = cut_head(pipeline.tracker, image, pipeline.tracker.track(image))
    return pipeline.encode(image), read_source(pipeline.deformer, pipeline.layout, crop)


@pytest.fixture(scope="session")
def avatar(encoded: tuple[Avatar, Source]) -> Avatar:
    """Of the sample portrait."""
    return encoded[0]


@pytest.fixture(scope="session")
def source(encoded: tuple[Avatar, Source]) -> Source:
    """Of the sample portrait: what the encoder is given."""
    return encoded[1]


@pytest.fixture
def one_thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Pictures as small as training tests use gain nothing from a second thread."""
    import torch

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def official_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A made-up official release in ``whole``, its import in ``model``, what the command said in
    ``said``. Made once: it takes a minute and more than a gigabyte.

    It replaces an earlier import (kept in ``earlier``), whose folder the command knows by
    ``link``; without --replace that was ``refused``."""
    import made_official  # needs PyTorch, which few tests do

    from cvthead.cli.main import main

    base = tmp_path_factory.mktemp("official")
    (base / "whole").mkdir()
    made_official.write_whole(base / "whole", made_official.state(), made_official.tables())
    made_official.earlier_import(base / "model")
    shutil.copytree(base / "model", base / "earlier")
    (base / "link").symlink_to(base / "model")
    said, refused = io.StringIO(), io.StringIO()
    command = ["import-official", str(base / "whole"), "-o", str(base / "link")]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(refused):
        assert main(command) == 2
        assert main([*command, "--replace"]) == 0
    (base / "said").write_text(said.getvalue())
    (base / "refused").write_text(refused.getvalue())
    yield base
    shutil.rmtree(base)
