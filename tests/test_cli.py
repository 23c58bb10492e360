"""The command line on the sample portrait, and on everything that can be wrong."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from cvthead.avatar import Avatar
from cvthead.cli.bench import table
from cvthead.cli.main import main
from cvthead.images import encode_image, read_image
from cvthead.provenance import SourceType, read_mark
from cvthead.video import probe_video, read_frames
from cvthead.video_writer import video_writer

EXAMPLES = Path(__file__).parents[1] / "examples"
BENCHMARK = Path(__file__).parents[1] / "docs" / "benchmark.md"
PORTRAIT = EXAMPLES / "astronaut.png"


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "me.avatar"
    assert main(["encode", str(PORTRAIT), "-o", str(path)]) == 0
    return path


def png_header(width: int, height: int) -> bytes:
    """A PNG file that promises a picture of this size and holds none."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(10))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels)


def refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str], *, remains: set[str], folder: Path
) -> str:
    """Run a command that must fail as wrong input does; returns its message."""
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("cvthead: error: ")
    assert "; " in lines[0], "a remedy"
    assert captured.out == ""
    assert {path.name for path in folder.iterdir()} == remains
    return lines[0]


PICTURES = {
    "not an image": (b"This is no picture." * 100, "not a PNG, JPEG or WebP"),
    "empty": (b"", "empty file"),
    "truncated": (PORTRAIT.read_bytes()[:50_000], "truncated"),
    "1 x 1": (encode_image(np.zeros((1, 1, 3), np.uint8)), "too small: 1 x 1 px"),
    "20,000 x 20,000": (png_header(20_000, 20_000), "too large: 20,000 x 20,000 px"),
}


@pytest.mark.parametrize("command", ["encode", "animate", "track", "sweep"])
@pytest.mark.parametrize("kind", PICTURES)
def test_bad_picture(
    command: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, message = PICTURES[kind]
    (tmp_path / "in.png").write_bytes(data)
    output = ["-o", str(tmp_path / ("out.avatar" if command == "encode" else "out.png"))]
    if command == "track":
        output = ["--overlay", str(tmp_path / "out.png")]
    if command == "animate":
        output += ["--driving", str(EXAMPLES / "talk.json")]
    arguments = [command, str(tmp_path / "in.png"), *output]
    assert message in refused(arguments, capsys, remains={"in.png"}, folder=tmp_path)


def test_no_face(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (300, 300, 3), dtype=np.uint8)
    (tmp_path / "noise.png").write_bytes(encode_image(noise))
    arguments = ["encode", str(tmp_path / "noise.png"), "-o", str(tmp_path / "me.avatar")]
    assert "no face" in refused(arguments, capsys, remains={"noise.png"}, folder=tmp_path)


def test_several_faces_are_named_with_their_places(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = read_image(PORTRAIT)[:300, 60:360]
    (tmp_path / "two.png").write_bytes(encode_image(np.hstack([one, one])))
    picture, output = str(tmp_path / "two.png"), str(tmp_path / "me.avatar")
    arguments = ["encode", picture, "--only-one", "-o", output]
    message = refused(arguments, capsys, remains={"two.png"}, folder=tmp_path)
    assert "2 faces" in message
    assert "face 0 at" in message
    arguments = ["encode", picture, "--face", "7", "-o", output]
    assert "number 7" in refused(arguments, capsys, remains={"two.png"}, folder=tmp_path)
    assert main(["encode", picture, "--face", "1", "-o", output]) == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--expression", "0=nan"], "NaN"),
        (["--expression", ",".join(["nan"] * 50)], "NaN"),
        (["--jaw", "inf,0,0"], "infinite"),
        (["--expression", "1,2,3"], "has 3 numbers, expected 50"),
        (["--shape", ",".join(["0"] * 50)], "has 50 numbers, expected 100"),
        (["--pose", "0,0,0"], "has 3 numbers, expected 15"),
        (["--jaw", "0"], "has 1 numbers, expected 3"),
        (["--jaw", "0,zero,0"], "not a number"),
        (["--expression", "50=1"], "no index 50"),
        (["--expression", "0=1,2"], "mixes"),
        (["--expression", "0=1e9"], "beyond"),
        (["--expression", "missing.json"], "cannot read missing.json"),
        (["--arkit", "smile=0.5"], "smile"),
        (["--arkit", "jawOpen=3"], "jawOpen"),
        (["--arkit", "0.3"], "name=number"),
        (["--background", "pink"], "--background pink"),
        (["--size", "100000"], "--size 100000"),
        (["--size", "big"], "--size"),
        (["--mode", "sideways"], "--mode"),
        (["--unknown"], "--unknown"),
    ],
)
def test_bad_coefficients_and_options(
    options: list[str],
    message: str,
    avatar: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["render", str(avatar), *options, "-o", str(tmp_path / "out.png")]
    assert message in refused(arguments, capsys, remains=set(), folder=tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[1, 2]", "holds no object"),
        ('{"frames": []}', "no frames"),
        ('{"frames": [{}, {"expression": [0, 1]}]}', "frame 1 expression has 2 numbers"),
        ('{"frames": [{"jaw": [0, NaN, 0]}]}', "NaN"),
        ('{"frames": [{"jaw": "open"}]}', "not a list"),
        ('{"frames": [{"jaws": [0, 0, 0]}]}', "unknown key 'jaws'"),
        ('{"frames": [{}, {"arkit": {"grin": 1}}]}', "grin"),
        ('{"frames": [{"camera": [0, 0, 0]}]}', "scale"),
        ('{"fps": 0, "frames": [{}]}', "fps"),
    ],
)
def test_bad_motion_file(
    text: str, message: str, avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "motion.json").write_text(text)
    arguments = ["animate", str(avatar), "--driving", str(tmp_path / "motion.json")]
    arguments += ["--camera", "driver", "-o", str(tmp_path / "out.mp4")]
    assert message in refused(arguments, capsys, remains={"motion.json"}, folder=tmp_path)


def test_unwritable_output(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, full = tmp_path / "file", tmp_path / "full"
    file.touch()
    full.mkdir()
    (full / "kept.txt").touch()
    for output in (tmp_path / "absent" / "out.png", file / "out.png", tmp_path / "out.bmp"):
        arguments = ["render", str(avatar), "-o", str(output)]
        refused(arguments, capsys, remains={"file", "full"}, folder=tmp_path)
    arguments = ["animate", str(avatar), "--driving", str(EXAMPLES / "talk.json")]
    refused([*arguments, "-o", str(full)], capsys, remains={"file", "full"}, folder=tmp_path)
    assert [path.name for path in full.iterdir()] == ["kept.txt"]


def test_damaged_avatar_keeps_the_earlier_picture(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, picture = tmp_path / "damaged.avatar", tmp_path / "out.png"
    damaged.write_bytes(avatar.read_bytes()[:10_000])
    picture.write_bytes(b"earlier")
    arguments = ["render", str(damaged), "-o", str(picture)]
    refused(arguments, capsys, remains={"damaged.avatar", "out.png"}, folder=tmp_path)
    assert picture.read_bytes() == b"earlier"


def test_transparent_needs_a_format_with_alpha(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["render", str(avatar), "--background", "transparent"]
    arguments += ["-o", str(tmp_path / "out.jpg")]
    assert "transparent" in refused(arguments, capsys, remains=set(), folder=tmp_path)


def test_official_preset_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["encode", str(PORTRAIT), "--preset", "official", "-o", str(tmp_path / "a.avatar")]
    assert "official" in refused(arguments, capsys, remains=set(), folder=tmp_path)


def test_encode_without_deformation(avatar: Path, tmp_path: Path) -> None:
    bald = tmp_path / "bald.avatar"
    assert main(["encode", str(PORTRAIT), "--no-deformation", "-o", str(bald)]) == 0
    assert not Avatar.load(bald).deformation.offsets.any()
    assert Avatar.load(avatar).deformation.offsets.any()


def test_render_backgrounds_and_sizes(avatar: Path, tmp_path: Path) -> None:
    def rendered(name: str, *options: str) -> bytes:
        path = tmp_path / name
        assert main(["render", str(avatar), *options, "-o", str(path)]) == 0
        return path.read_bytes()

    white = rendered("white.png")
    assert read_mark(white) == SourceType.GENERATED
    assert read_image(tmp_path / "white.png").shape == (256, 256, 3)
    source = rendered("source.jpg", "--background", "source")
    assert read_mark(source) == SourceType.COMPOSITE
    rendered("green.webp", "--background", "#00ff00", "--size", "100")
    green = read_image(tmp_path / "green.webp")
    assert green.shape == (100, 100, 3)
    assert np.abs(green[2, 2].astype(int) - (0, 255, 0)).max() < 30
    rendered("clear.png", "--background", "transparent", "--size", "300")
    # Reading composites on white, so both ways lead to the same picture.
    clear = read_image(tmp_path / "clear.png").astype(int)
    rendered("large.png", "--size", "300")
    assert np.abs(clear - read_image(tmp_path / "large.png")).mean() < 1


def test_render_names_the_preset_of_another_avatar(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out.png"
    assert main(["render", str(avatar), "--preset", "open", "-o", str(path)]) == 0
    assert main(["render", str(avatar), "--preset", "official", "-o", str(path)]) == 2
    assert "use --preset open" in capsys.readouterr().err


def test_render_forms_of_coefficients_agree(avatar: Path, tmp_path: Path) -> None:
    expression = Avatar.load(avatar).coefficients.expression.tolist()
    expression[3] = -1.5
    (tmp_path / "list.json").write_text(json.dumps(expression))
    (tmp_path / "sparse.txt").write_text('{"3": -1.5}')
    forms = [
        "3=-1.5",
        str(tmp_path / "list.json"),
        f"@{tmp_path / 'sparse.txt'}",
        ",".join(map(repr, expression)),
    ]
    pictures = []
    for number, text in enumerate(forms):
        path = tmp_path / f"{number}.png"
        assert main(["render", str(avatar), "--expression", text, "-o", str(path)]) == 0
        pictures.append(read_image(path))
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])


def test_render_accepts_a_value_that_starts_with_minus(avatar: Path, tmp_path: Path) -> None:
    spaced, joined = tmp_path / "a.png", tmp_path / "b.png"
    assert main(["render", str(avatar), "--global", "-0.1,0.4,0", "-o", str(spaced)]) == 0
    assert main(["render", str(avatar), "--global=-0.1,0.4,0", "-o", str(joined)]) == 0
    plain = tmp_path / "c.png"
    assert main(["render", str(avatar), "-o", str(plain)]) == 0
    np.testing.assert_array_equal(read_image(spaced), read_image(joined))
    assert np.abs(read_image(spaced).astype(int) - read_image(plain)).mean() > 0.5


def test_track_report_drives_an_animation(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report, overlay = tmp_path / "fit.json", tmp_path / "fit.png"
    picture = str(PORTRAIT)
    assert main(["track", picture, "--overlay", str(overlay), "--json", str(report)]) == 0
    assert read_image(overlay).shape == read_image(PORTRAIT).shape
    capsys.readouterr()
    assert main(["track", picture, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(report.read_text())
    assert len(printed["tracked"]["landmarks"]) == 478
    assert len(printed["tracked"]["arkit"]) == 51  # tongueOut has no score
    # The portrait driven by its own coefficients is the portrait.
    driven, plain = tmp_path / "driven.png", tmp_path / "plain.png"
    assert main(["animate", str(avatar), "--driving", str(report), "-o", str(driven)]) == 0
    assert main(["render", str(avatar), "-o", str(plain)]) == 0
    difference = np.abs(read_image(driven).astype(int) - read_image(plain))
    assert difference.mean() < 0.5


def motion(folder: Path, frames: int) -> Path:
    path = folder / "motion.json"
    content = [{"arkit": {"jawOpen": i / frames}} for i in range(frames)]
    path.write_text(json.dumps({"fps": 10, "frames": content}))
    return path


@pytest.mark.parametrize("name", ["out.mp4", "out.gif", "out.png", "frames/"])
def test_animate_formats(name: str, avatar: Path, tmp_path: Path) -> None:
    output = tmp_path / name
    arguments = ["animate", str(avatar), "--driving", str(motion(tmp_path, 3)), "--size", "64"]
    assert main([*arguments, "-o", str(output)]) == 0
    if name == "frames/":
        files = sorted(output.iterdir())
        assert [read_image(file).shape for file in files] == [(64, 64, 3)] * 3
        assert read_mark(files[0].read_bytes()) == SourceType.GENERATED
        return
    assert read_mark(output.read_bytes()) == SourceType.GENERATED
    info = probe_video(output)
    assert (info.width, info.height) == (64, 64)
    assert len(list(read_frames(output))) == 3


def test_animate_by_a_video(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    portrait = read_image(PORTRAIT)[:300, 60:360]
    blank = np.full_like(portrait, 200)
    driver = tmp_path / "driver.mp4"
    with video_writer(driver, size=(300, 300), fps=10) as write:
        for image in (blank, portrait, portrait, blank):
            write(image)
    output = tmp_path / "out.mp4"
    arguments = ["animate", str(avatar), "--driving", str(driver), "--relative"]
    assert main([*arguments, "--camera", "driver", "-o", str(output)]) == 0
    assert "no face in 2 of 4 frames" in capsys.readouterr().err
    times = [frame.time for frame in read_frames(output)]
    np.testing.assert_allclose(times, [0, 0.1, 0.2, 0.3], atol=1e-3)


def test_video_without_a_face_leaves_nothing(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    driver = tmp_path / "driver.mp4"
    with video_writer(driver, size=(200, 200), fps=10) as write:
        for _ in range(2):
            write(np.full((200, 200, 3), 200, np.uint8))
    arguments = ["animate", str(avatar), "--driving", str(driver)]
    arguments += ["-o", str(tmp_path / "out.mp4")]
    message = refused(arguments, capsys, remains={"driver.mp4"}, folder=tmp_path)
    assert "no frame" in message


def test_relative_needs_motion(
    avatar: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["animate", str(avatar), "--driving", str(PORTRAIT), "--relative"]
    arguments += ["-o", str(tmp_path / "out.png")]
    assert "motion" in refused(arguments, capsys, remains=set(), folder=tmp_path)


def test_sweep_cells_differ(avatar: Path, tmp_path: Path) -> None:
    output = tmp_path / "sweep.png"
    assert main(["sweep", str(avatar), "--cell", "64", "-o", str(output)]) == 0
    image = read_image(output)
    height, width = image.shape[:2]
    assert width > 7 * 64
    assert height > 6 * 64
    assert read_mark(output.read_bytes()) == SourceType.GENERATED


def test_bench_names_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    """In the keys that docs/benchmark.md lists, and in the table."""
    assert main(["bench", str(PORTRAIT), "--renders", "2", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    documented = BENCHMARK.read_text("utf-8").partition("| `preset` |")[2].partition("\n\n")[0]
    assert set(report) == {"preset", "threads", "encode", "render", "drive", "torch", "ratios"}
    printed = table(report)
    for part in ("encode", "render", "drive"):
        (line,) = (row for row in documented.splitlines() if row.startswith(f"| `{part}` |"))
        for stage, times in report[part].items():
            assert f"`{stage}`" in line
            assert f"\n{stage}" in printed
            assert 0 < times["median_ms"] <= times["p95_ms"]


def test_process_status_and_streams(tmp_path: Path) -> None:
    (tmp_path / "in.png").write_text("no picture")
    run = subprocess.run(
        [sys.executable, "-m", "cvthead.cli.main", "encode", "in.png", "-o", "out.avatar"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stdout == ""
    assert run.stderr.count("\n") == 1
    assert run.stderr.startswith("cvthead: error: not a PNG, JPEG or WebP picture")
    assert [path.name for path in tmp_path.iterdir()] == ["in.png"]


def test_help_of_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("encode", "render", "animate", "track", "sweep", "bench"):
        with pytest.raises(SystemExit) as stopped:
            main([command, "--help"])
        assert stopped.value.code == 0
        assert f"cvthead {command}" in capsys.readouterr().out
