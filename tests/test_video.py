from __future__ import annotations

import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from cvthead.errors import InputError, VideoError
from cvthead.files import atomic_path, write_file
from cvthead.images import read_image
from cvthead.provenance import SourceType, read_mark
from cvthead.video import probe_video, read_frames
from cvthead.video_writer import video_writer

FORMATS = ["out.mp4", "out.gif", "out.png", "out.apng", "out"]
SIZE = (64, 48)


def frame(number: int, width: int = 64, height: int = 48) -> NDArray[np.uint8]:
    """Smooth colours and a white bar that moves by 4 px a frame."""
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    image = np.stack([200 * x, 200 * y, 200 * (1 - x)], axis=-1).astype(np.uint8)
    image[:, number * 4 % width :][:, :4] = 255
    return image


def write(path: Path, count: int = 10, **options: object) -> Path:
    with video_writer(path, size=SIZE, fps=20, **options) as append:  # type: ignore[arg-type]
        for number in range(count):
            append(frame(number))
    return path


def driver(
    path: Path,
    audio: str | None = "aac",
    *,
    seconds: float = 2,
    video: str = "libx264",
    prepare: Callable[[av.VideoStream], None] | None = None,
) -> Path:
    """A black 25 fps video with a white flash and a tone from 1.0 s on."""
    with av.open(str(path), "w") as output:
        stream = output.add_stream(video, rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if prepare is not None:
            prepare(stream)
        sound: av.AudioStream | None = None
        if audio is not None:
            added = output.add_stream(audio, rate=48_000, layout="stereo")
            assert isinstance(added, av.AudioStream)
            sound = added
        for number in range(round(seconds * 25)):
            image = np.full((48, 64, 3), 255 if number >= 25 else 0, np.uint8)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            if sound is not None:
                time = (np.arange(1920) + number * 1920) / 48_000
                tone = np.sin(2 * np.pi * 440 * time) * (time >= 1) * 20_000
                wave = np.repeat(tone.astype(np.int16), 2)[None]
                samples = av.AudioFrame.from_ndarray(wave, format="s16", layout="stereo")
                samples.sample_rate, samples.pts = 48_000, number * 1920
                samples.time_base = Fraction(1, 48_000)
                output.mux(sound.encode(samples))
        output.mux(stream.encode(None))
        if sound is not None:
            output.mux(sound.encode(None))
    return path


def tone_start(path: Path) -> tuple[float, float]:
    """Seconds at which the sound gets loud, and at which it ends."""
    start = end = -1.0
    with av.open(str(path)) as container:
        for samples in container.decode(audio=0):
            assert samples.time is not None
            level = np.abs(samples.to_ndarray().astype(float)).max(axis=0)
            if samples.format.name.startswith("s16"):
                level /= 32768
            loud = np.flatnonzero(level > 0.2)
            if start < 0 and len(loud):
                start = samples.time + loud[0] / samples.sample_rate
            end = samples.time + samples.samples / samples.sample_rate
    return start, end


def boxes(data: bytes) -> list[bytes]:
    """Kinds of an MP4 file's top-level boxes."""
    found, position = [], 0
    while position < len(data):
        size, kind = struct.unpack_from(">I4s", data, position)
        found.append(kind)
        position += size
    assert position == len(data)
    return found


@pytest.mark.parametrize("name", FORMATS)
def test_frames_and_times_survive(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name)
    assert list(tmp_path.iterdir()) == [path]
    if name == "out":
        assert sorted(file.name for file in path.iterdir()) == [f"{i:06d}.png" for i in range(10)]
        for number, file in enumerate(sorted(path.iterdir())):
            assert np.array_equal(read_image(file), frame(number))
            assert read_mark(file.read_bytes()) == SourceType.GENERATED
        return
    frames = list(read_frames(path))
    assert [round(shown.time, 3) for shown in frames] == [round(i / 20, 3) for i in range(10)]
    for number, shown in enumerate(frames):
        assert shown.rgb.dtype == np.uint8
        assert shown.rgb.flags.c_contiguous
        error = np.abs(shown.rgb.astype(int) - frame(number)).mean()
        assert error < (5 if name in ("out.mp4", "out.gif") else 1e-9)
    assert read_mark(path.read_bytes()) == SourceType.GENERATED


def test_an_mp4_plays_in_browsers(tmp_path: Path) -> None:
    path = write(tmp_path / "out.mp4", source=SourceType.COMPOSITE)
    found = boxes(path.read_bytes())
    assert found.index(b"moov") < found.index(b"mdat")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.pix_fmt == "yuv420p"
        assert (stream.color_range, stream.colorspace) == (1, 1)  # limited range, BT.709
        assert container.metadata["comment"].endswith(SourceType.COMPOSITE)
        assert container.duration == pytest.approx(0.5 * av.time_base, abs=1000)
    info = probe_video(path)
    assert (info.width, info.height, info.frames, info.has_audio) == (64, 48, 10, False)
    assert info.fps == pytest.approx(20)
    assert info.duration == pytest.approx(0.5)


@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 90, 70)])
def test_colours_survive_in_mp4(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    path = tmp_path / "out.mp4"
    with video_writer(path, size=SIZE, fps=20) as append:
        append(np.full((48, 64, 3), colour, np.uint8))
    assert np.abs(next(read_frames(path)).rgb.astype(int) - colour).max() <= 4


@pytest.mark.parametrize("name", FORMATS)
def test_odd_sizes(tmp_path: Path, name: str) -> None:
    with video_writer(tmp_path / name, size=(33, 47), fps=20) as append:
        append(frame(0, 33, 47))
        append(frame(1, 33, 47))
    if name != "out":
        rgb = next(read_frames(tmp_path / name)).rgb
        assert rgb.shape == ((48, 34, 3) if name == "out.mp4" else (47, 33, 3))


def test_alpha_is_kept_in_animated_png_and_put_on_white_elsewhere(tmp_path: Path) -> None:
    image = np.dstack([np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint8)])
    image[:, 32:, 3] = 255
    for name in FORMATS:
        with video_writer(tmp_path / name, size=SIZE, fps=20) as append:
            append(image)
            append(image)
    for path in (tmp_path / "out.png", tmp_path / "out" / "000001.png"):
        with Image.open(path) as opened:
            assert np.array_equal(np.asarray(opened)[..., 3], image[..., 3])
    for path in (tmp_path / "out.mp4", tmp_path / "out.gif"):
        rgb = next(read_frames(path)).rgb
        assert rgb[:, :30].min() > 250
        assert rgb[:, 34:].max() < 5


@pytest.mark.parametrize("name", ["out.gif", "out.png"])
def test_pillow_plays_the_animation_endlessly(tmp_path: Path, name: str) -> None:
    with Image.open(write(tmp_path / name)) as image:
        assert image.n_frames == 10  # type: ignore[attr-defined]
        assert image.info["loop"] == 0
        for number in range(10):
            image.seek(number)
            assert image.info["duration"] == 50
            decoded = np.asarray(image.convert("RGB")).astype(int)
            assert np.abs(decoded - frame(number)).mean() < 5


def test_a_gif_drops_frames_that_browsers_would_slow_down(tmp_path: Path) -> None:
    path = tmp_path / "out.gif"
    with video_writer(path, size=SIZE, fps=100) as append:
        for number in range(40):
            append(frame(number))
    times = [shown.time for shown in read_frames(path)]
    assert min(np.diff(times)) >= 0.0199
    assert times[-1] == pytest.approx(0.38)


@pytest.mark.parametrize("name", ["out.mp4", "out.gif", "out.png"])
def test_irregular_times_are_kept(tmp_path: Path, name: str) -> None:
    times = [0.0, 0.05, 0.3, 0.34, 1.0]
    path = tmp_path / name
    with video_writer(path, size=SIZE, fps=25) as append:
        for number, time in enumerate(times):
            append(frame(number), time)
    assert [shown.time for shown in read_frames(path)] == pytest.approx(times, abs=0.002)


@pytest.mark.parametrize(
    ("name", "audio", "video"),
    [
        ("a.mp4", "aac", "libx264"),
        ("a.mov", "pcm_s16le", "libx264"),
        ("a.mkv", "aac", "libx264"),
        ("a.ts", "aac", "libx264"),
        ("a.webm", "libopus", "libvpx"),
        ("a.avi", "mp3", "mpeg4"),
    ],
)
def test_the_sound_is_kept_in_time(tmp_path: Path, name: str, audio: str, video: str) -> None:
    source = driver(tmp_path / name, audio, video=video)
    assert probe_video(source).has_audio
    path = tmp_path / "out.mp4"
    with video_writer(path, size=SIZE, fps=25, audio_from=source) as append:
        for shown in read_frames(source):
            append(shown.rgb, shown.time)
    flash = next(shown.time for shown in read_frames(path) if shown.rgb.mean() > 128)
    tone, end = tone_start(path)
    assert flash == pytest.approx(1, abs=0.045)
    assert tone == pytest.approx(flash, abs=0.03)
    assert end == pytest.approx(2, abs=0.06)
    with av.open(str(path)) as container:
        assert container.streams.audio[0].codec_context.name == "aac"
    found = boxes(path.read_bytes())
    assert found.index(b"moov") < found.index(b"mdat")


def test_aac_is_copied_not_encoded_again(tmp_path: Path) -> None:
    source = driver(tmp_path / "a.mp4")
    write(tmp_path / "out.mp4", count=40, audio_from=source)

    def packets(path: Path) -> list[bytes]:
        with av.open(str(path)) as container:
            return [bytes(packet) for packet in container.demux(audio=0) if packet.size]

    assert packets(tmp_path / "out.mp4") == packets(source)


def test_the_sound_ends_with_the_pictures(tmp_path: Path) -> None:
    for name, codec in (("a.mp4", "aac"), ("a.mov", "pcm_s16le")):
        source = driver(tmp_path / name, codec)
        write(tmp_path / "out.mp4", count=10, audio_from=source)
        assert tone_start(tmp_path / "out.mp4")[1] == pytest.approx(0.5, abs=0.06)
        write(tmp_path / "out.mp4", count=60, audio_from=source)
        assert probe_video(tmp_path / "out.mp4").duration == pytest.approx(3, abs=0.01)


def test_no_sound_to_keep(tmp_path: Path) -> None:
    silent = driver(tmp_path / "a.mp4", None)
    write(tmp_path / "out.mp4", audio_from=silent)
    assert not probe_video(tmp_path / "out.mp4").has_audio
    with pytest.raises(VideoError, match="no file"):
        write(tmp_path / "other.mp4", audio_from=tmp_path / "absent.mp4")
    assert not (tmp_path / "other.mp4").exists()


def test_rotation_is_honoured(tmp_path: Path) -> None:
    one = 1 << 16
    corner = np.zeros((48, 64, 3), np.uint8)
    corner[:16, :16] = 255
    # A phone held upright: its file asks for a clockwise quarter turn.
    clockwise = [0, one, 0, -one, 0, 0, 0, 0, 1 << 30]
    half = [-one, 0, 0, 0, -one, 0, 0, 0, 1 << 30]
    for matrix, expected in ((clockwise, np.rot90(corner, -1)), (half, np.rot90(corner, 2))):
        path = tmp_path / "a.mp4"
        with av.open(str(path), "w") as output:
            stream = output.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            stream.set_display_matrix(matrix)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(corner, format="rgb24")))
            output.mux(stream.encode(None))
        rgb = next(read_frames(path)).rgb
        assert rgb.shape == expected.shape
        assert np.abs(rgb.astype(int) - expected).mean() < 10
        info = probe_video(path)
        assert (info.height, info.width) == expected.shape[:2]


def test_pixels_become_square(tmp_path: Path) -> None:
    def prepare(stream: av.VideoStream) -> None:
        stream.codec_context.sample_aspect_ratio = Fraction(2, 1)

    assert probe_video(driver(tmp_path / "a.mp4", prepare=prepare)).width == 128


def test_reading_can_stop_early(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4")
    frames = read_frames(path)
    next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert len(list(read_frames(path))) == 10


def chunk(kind: bytes, body: bytes) -> bytes:
    crc = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + crc


def bomb(kind: str, side: int) -> bytes:
    if kind == "gif":
        start = b"GIF89a" + struct.pack("<HHBBB", side, side, 0x80, 0, 0) + bytes(6)
        return start + b"\x2c" + struct.pack("<HHHHB", 0, 0, side, side, 0) + b"\2\2\x4c\1\0;"
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    control = chunk(b"fcTL", struct.pack(">IIIIIHHBB", 0, side, side, 0, 0, 1, 25, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    start = b"\x89PNG\r\n\x1a\n" + header + chunk(b"acTL", struct.pack(">II", 2, 0))
    return start + control + pixels


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's /proc")
def test_bombs_are_refused_without_allocating(tmp_path: Path) -> None:
    for kind in ("gif", "apng"):
        for side in (12_000, 20_000, 30_000, 60_000):
            (tmp_path / f"{side}.{kind}").write_bytes(bomb(kind, side))
    script = """
import re, sys
from pathlib import Path
from cvthead.errors import VideoError
from cvthead.video import probe_video
def peak():
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
before = peak()
for file in Path(sys.argv[1]).iterdir():
    try:
        probe_video(file)
        print("accepted", file)
    except VideoError:
        pass
print(peak() - before)
"""
    run = [sys.executable, "-c", script, str(tmp_path)]
    repository = Path(__file__).parents[1]
    result = subprocess.run(run, capture_output=True, text=True, cwd=repository, check=True)
    assert re.fullmatch(r"\d+\n", result.stdout)
    assert int(result.stdout) < 50_000  # kB; 12,000 x 12,000 px would take 432,000


def test_a_playlist_cannot_open_other_files(tmp_path: Path) -> None:
    secret = write(tmp_path / "secret.mp4")
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n"
    concat = f"ffconcat version 1.0\nfile {secret}\n"
    for name in ("list.m3u8", "list.mp4"):
        for text in (playlist, concat):
            (tmp_path / name).write_text(text)
            with pytest.raises(VideoError):
                probe_video(tmp_path / name)


def test_bad_files_are_refused(tmp_path: Path) -> None:
    whole = driver(tmp_path / "whole.mkv", None).read_bytes()
    index_last = driver(tmp_path / "whole.mp4").read_bytes()
    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as output:
        stream = output.add_stream("aac", rate=48_000, layout="mono")
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 9600), np.int16), "s16", "mono")
        samples.sample_rate = 48_000
        output.mux(stream.encode(samples))
        output.mux(stream.encode(None))
    for name, data in {
        "empty.mp4": b"",
        "text.mp4": b"this is no video, whatever its name says" * 100,
        "picture.jpg": b"\xff\xd8\xff\xe0" + bytes(1000),
        "header.mkv": whole[:200],
        "no_index.mp4": index_last[: len(index_last) // 2],
        "sound_only.mp4": sound.read_bytes(),
    }.items():
        (tmp_path / name).write_bytes(data)
        for read in (probe_video, lambda path: list(read_frames(path))):
            with pytest.raises(VideoError) as caught:
                read(tmp_path / name)
            assert caught.value.hint
    for path in (tmp_path, tmp_path / "absent.mp4"):
        with pytest.raises(VideoError, match="no file"):
            probe_video(path)


def test_a_truncated_mp4_is_noticed(tmp_path: Path) -> None:
    data = write(tmp_path / "a.mp4", count=100).read_bytes()
    for part in (0.5, 0.7, 0.9):
        (tmp_path / "cut.mp4").write_bytes(data[: int(len(data) * part)])
        with pytest.raises(VideoError):
            list(read_frames(tmp_path / "cut.mp4"))


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.gif"])
def test_damage_raises_nothing_but_video_error(tmp_path: Path, name: str) -> None:
    source = write(tmp_path / name) if name != "a.mkv" else driver(tmp_path / name)
    whole = np.frombuffer(source.read_bytes(), np.uint8)
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(60):
        data = whole.copy()
        data[rng.integers(8, len(data), 8)] = rng.integers(0, 256, 8)
        (tmp_path / "damaged").write_bytes(data.tobytes())
        try:
            probe_video(tmp_path / "damaged")
            for shown in read_frames(tmp_path / "damaged"):
                assert shown.rgb.shape[2] == 3
        except VideoError:
            refused += 1
    assert refused < 60


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("frames", [0, 3])
def test_nothing_is_left_after_a_failure(tmp_path: Path, name: str, frames: int) -> None:
    for error in (RuntimeError, KeyboardInterrupt, OSError):
        with pytest.raises(error), video_writer(tmp_path / name, size=SIZE, fps=20) as append:  # noqa: PT012
            for number in range(frames):
                append(frame(number))
            raise error
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", FORMATS)
def test_a_refused_frame_leaves_nothing(tmp_path: Path, name: str) -> None:
    wrong = {
        "has 32 x 48 px": (frame(0, 32, 48), None),
        "shape": (np.zeros((48, 64), np.uint8), None),
        "type float64": (np.zeros((48, 64, 3)), None),
        "timed": (frame(0), 0.0),
    }
    for message, (image, time) in wrong.items():
        with (  # noqa: PT012
            pytest.raises(VideoError, match=message),
            video_writer(tmp_path / name, size=SIZE, fps=20) as append,
        ):
            append(frame(0))
            append(image, time)  # type: ignore[arg-type]
    with (
        pytest.raises(VideoError, match="no frame"),
        video_writer(tmp_path / name, size=SIZE, fps=20),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    path.write_bytes(b"earlier")
    with pytest.raises(RuntimeError), video_writer(path, size=SIZE, fps=20) as append:  # noqa: PT012
        append(frame(0))
        raise RuntimeError
    assert path.read_bytes() == b"earlier"
    write(path)
    assert len(list(read_frames(path))) == 10


def test_outputs_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"\.avi"):
        write(tmp_path / "out.avi")
    with pytest.raises(InputError, match="not a folder"):
        write(tmp_path / "absent" / "out.mp4")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    for taken in ("full", "folder.mp4"):
        with pytest.raises(InputError, match="already there"):
            write(tmp_path / taken)
    (tmp_path / "empty").mkdir()
    assert len(list(write(tmp_path / "empty").iterdir())) == 10
    for options in ({"fps": 0, "size": SIZE}, {"fps": 20, "size": (0, 48)}):
        with (
            pytest.raises(VideoError, match="cannot write"),
            video_writer(tmp_path / "out.mp4", **options),  # type: ignore[arg-type]
        ):
            pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "folder.mp4", "full"]


@pytest.mark.skipif(sys.platform == "win32", reason="limits the file size as POSIX does")
@pytest.mark.parametrize("name", ["out.mp4", "out.gif", "out.png"])
def test_a_full_disk(tmp_path: Path, name: str) -> None:
    # A limited file size, in a process of its own, stands for the full disk.
    script = """
import resource, signal, sys
import numpy as np
from cvthead.errors import InputError
from cvthead.video_writer import video_writer
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
rng = np.random.default_rng(0)
try:
    with video_writer(sys.argv[1], size=(256, 256), fps=20) as append:
        for _ in range(10):
            append(rng.integers(0, 256, (256, 256, 3), dtype=np.uint8))
except InputError as error:
    print(error)
"""
    run = [sys.executable, "-c", script, str(tmp_path / name)]
    repository = Path(__file__).parents[1]
    result = subprocess.run(run, capture_output=True, text=True, cwd=repository, check=False)
    assert "cannot write" in result.stdout, result.stderr
    assert list(tmp_path.iterdir()) == []


def test_atomic_path(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_file(target, b"one")
    with pytest.raises(ValueError, match="stop"), atomic_path(target) as temporary:  # noqa: PT012
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"two")
        raise ValueError("stop")
    assert target.read_bytes() == b"one"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"three")
        assert target.read_bytes() == b"one"
    assert target.read_bytes() == b"three"
    assert list(tmp_path.iterdir()) == [target]
    with pytest.raises(InputError, match="cannot write"), atomic_path(target):
        pass  # nothing was written, so nothing can be renamed
