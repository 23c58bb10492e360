"""``cvthead-call`` against a real server: a video in, an animated portrait out."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cvthead_client import Client, Hello
from cvthead_client.call import main
from cvthead_client.driver import picture_sender
from cvthead_client.errors import AvatarNotFoundError, CVTHeadClientError
from cvthead_client.live import LAST_SECONDS, Call
from cvthead_client.media import Captured, read_video
from cvthead_client.window import show
from PIL import Image
from server_process import PORTRAIT, Server

from cvthead.provenance import SourceType, read_mark
from cvthead.video import probe_video, read_frames
from cvthead.video_writer import video_writer

ANGLES = (0, 4, 8, 12, 8, 4)
FACELESS = 3  # this frame of the clip shows no face


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample portrait tilts; one frame is blank."""
    path = tmp_path_factory.mktemp("clip") / "driver.mp4"
    with Image.open(PORTRAIT) as portrait, video_writer(path, size=(512, 512), fps=10) as write:
        for number, angle in enumerate(ANGLES):
            turned = portrait.convert("RGB").rotate(angle, fillcolor="white")
            write(np.full((512, 512, 3), 90, np.uint8) if number == FACELESS else np.array(turned))
    return path


def test_numbers_and_pictures_give_the_same_animation(
    server: Server, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every frame, also the one without a face, in all ways of following the driver."""
    for options in ([], ["--relative", "--camera", "driver"]):
        results = []
        for how in ("--coefficients", "--frames"):
            output = tmp_path / f"{how}.mp4"
            arguments = [str(clip), "--server", server.url, "--portrait", str(PORTRAIT)]
            assert main([*arguments, how, "--output", str(output), *options]) == 0
            told = capsys.readouterr()
            assert told.out.strip() == str(output)
            assert "no face in 1 frames" in told.err
            assert ("only numbers" in told.err) == (how == "--coefficients")
            assert read_mark(output.read_bytes()) == SourceType.GENERATED
            frames = [frame.rgb.astype(np.int16) for frame in read_frames(output)]
            assert len(frames) == len(ANGLES)
            results.append(frames)
        numbers, pictures = results
        moved = max(np.abs(frame - numbers[0]).mean() for frame in numbers)
        apart = max(np.abs(a - b).mean() for a, b in zip(numbers, pictures, strict=True))
        assert moved > 3 * apart, (moved, apart)
        # Held, so far as the video codec lets one see it.
        assert np.abs(numbers[FACELESS] - numbers[FACELESS - 1]).mean() < moved / 4
    assert probe_video(output).duration == pytest.approx(len(ANGLES) / 10, abs=0.11)
    with Client(server.url) as client:
        known = {info.id for info in client.list()}
        assert main([str(clip), "--server", server.url, "--portrait", str(PORTRAIT), "--frames",
                     "--output", str(output)]) == 0  # fmt: skip
        assert {info.id for info in client.list()} == known  # its avatar is gone again


def run_without_the_package(*arguments: str) -> subprocess.CompletedProcess[str]:
    """In a process in which nothing of the heavy packages can be imported."""
    missing = ("cvthead", "torch", "onnxruntime", "cv2", "scipy")
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({missing}))\n"
        "from cvthead_client.call import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    return subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=300
    )


def test_without_the_full_package(
    server: Server, avatar_id: str, clip: Path, tmp_path: Path
) -> None:
    output = tmp_path / "out.mp4"
    arguments = (
        str(clip), "--server", server.url, "--avatar", avatar_id, "--output", str(output),
    )  # fmt: skip
    refused = run_without_the_package(*arguments, "--coefficients")
    assert refused.returncode == 2
    assert "use --frames" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert not output.exists()
    done = run_without_the_package(*arguments)  # pictures are the default then
    assert done.returncode == 0, done.stderr
    assert "sending pictures" in done.stderr
    assert probe_video(output).frames == len(ANGLES)
    with Client(server.url) as client:
        client.get(avatar_id)  # an avatar that was there before stays


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{clip}", "--portrait", "{portrait}", "--output", "out.gif"], "out.gif"),
        (["{clip}", "--portrait", "nobody.png", "--output", "{out}"], "nobody.png"),
        (["{portrait}", "--portrait", "{portrait}", "--output", "{out}"], "astronaut.png"),
        (["/dev/no-camera", "--portrait", "{portrait}", "--output", "{out}"], "/dev/no-camera"),
        (["{clip}", "--avatar", "0" * 32, "--output", "{out}"], "no such avatar"),
        (["{clip}", "--output", "{out}"], "required"),
        (["{clip}", "--portrait", "{portrait}", "--size", "9999", "--output", "{out}"], "size"),
    ],
    ids=["ending", "portrait", "not a video", "camera", "avatar", "nobody", "size"],
)
def test_one_line_for_what_is_wrong(
    server: Server,
    clip: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    out = tmp_path / "out.mp4"
    filled = [a.format(clip=clip, portrait=PORTRAIT, out=out) for a in arguments]
    assert main([*filled, "--server", server.url, "--frames"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("cvthead-call: error: ")
    assert message in error
    assert list(tmp_path.iterdir()) == []


def test_nobody_at_that_address(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(clip), "--server", "http://127.0.0.1:9", "--avatar", "0" * 32, "--frames"]
    assert main(arguments) == 2
    assert "is the service running" in capsys.readouterr().err


def paced(clip: Path, enough: Callable[[], bool]) -> Iterator[Captured]:
    """The clip again and again until there is enough, as a camera would give it."""
    begin = time.monotonic()
    pictures = [frame.rgb for frame in read_video(clip)]
    for rgb in itertools.cycle(pictures):
        time.sleep(0.04)
        now = time.monotonic() - begin
        if enough() or now > 120:
            return
        yield Captured(rgb, now)


def test_live_call(server: Server, avatar_id: str, clip: Path) -> None:
    shown: list[tuple[np.ndarray, float]] = []
    begin = time.monotonic()
    with Client(server.url) as client, client.stream(avatar_id, Hello()) as stream:
        source = paced(clip, lambda: len(shown) >= 6)
        call = Call(source, picture_sender(stream), stream, lambda *frame: shown.append(frame))
        call.start()
        call.wait()
        assert "frames/s" in call.summary()
    times = [seconds for _, seconds in shown]
    assert len(shown) >= 6
    assert times == sorted(times)
    # The newest frames were shown: of a queue the sixth would be 0.2 s old, however slow it is.
    assert times[5] > (time.monotonic() - begin - LAST_SECONDS) / 4
    assert len({image.tobytes() for image, _ in shown}) > 1


def test_live_call_can_be_stopped(server: Server, avatar_id: str, clip: Path) -> None:
    def endless() -> Iterator[Captured]:
        rgb = next(read_video(clip)).rgb
        for number in itertools.count():
            yield Captured(rgb, number / 25)

    with Client(server.url) as client, client.stream(avatar_id) as stream:
        call = Call(endless(), picture_sender(stream), stream, lambda *_: call.stop())
        call.start()
        call.wait()
        assert call.over


def test_live_call_reports_why_it_ended(server: Server, clip: Path) -> None:
    with Client(server.url) as client:
        identifier = client.create(PORTRAIT).id
        with client.stream(identifier) as stream:
            source = paced(clip, lambda: False)
            call = Call(source, picture_sender(stream), stream, lambda *_: None)
            call.start()
            client.delete(identifier)
            with pytest.raises(AvatarNotFoundError):
                call.wait()


def test_window_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tkinter")
    if sys.platform != "linux":
        pytest.skip("other systems always have a display")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(CVTHeadClientError) as raised:
        show(lambda: None, lambda: "title")
    assert "out.mp4" in raised.value.hint


def test_window_shows_frames() -> None:
    pytest.importorskip("tkinter")
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        pytest.skip("no display")
    images = iter([np.zeros((32, 32, 3), np.uint8), None, np.ones((32, 32, 3), np.uint8)])
    titles = itertools.count()
    show(lambda: next(images), lambda: f"frame {next(titles)}")
    assert next(titles) == 3  # once at the start and once per frame
