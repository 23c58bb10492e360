from __future__ import annotations

import shutil
import struct
import subprocess
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from cvthead.images import encode_image
from cvthead.provenance import SourceType, mark_gif, mark_png, mp4_box, read_mark, xmp_packet
from cvthead.video_writer import video_writer

NAME = "{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType"
STILLS = ["png", "jpeg", "webp"]
VIDEOS = ["mp4", "gif", "apng"]


def still(kind: str, source: SourceType = SourceType.GENERATED) -> bytes:
    image = np.random.default_rng(0).integers(0, 256, (40, 48, 4), dtype=np.uint8)
    return encode_image(image, kind, source=source)  # type: ignore[arg-type]


def video(folder: Path, kind: str, source: SourceType = SourceType.GENERATED) -> bytes:
    path = folder / f"video.{kind}"
    with video_writer(path, size=(48, 40), fps=10, source=source) as write:
        for level in (0, 100, 200):
            write(np.full((40, 48, 3), level, np.uint8))
    return path.read_bytes()


def made(folder: Path, kind: str, source: SourceType = SourceType.GENERATED) -> bytes:
    return still(kind, source) if kind in STILLS else video(folder, kind, source)


@pytest.mark.parametrize("source", SourceType)
@pytest.mark.parametrize("kind", STILLS + VIDEOS)
def test_the_mark_can_be_read_back(tmp_path: Path, kind: str, source: SourceType) -> None:
    assert read_mark(made(tmp_path, kind, source)) == source


@pytest.mark.parametrize("kind", [*STILLS, "apng"])
def test_pillow_finds_the_mark(tmp_path: Path, kind: str) -> None:
    with Image.open(BytesIO(made(tmp_path, kind))) as image:
        packet = image.info["xmp"]
        image.load()
    values = [element.text for element in ElementTree.fromstring(packet).iter(NAME)]
    assert values == ["http://cv.iptc.org/newscodes/digitalsourcetype/trainedAlgorithmicMedia"]


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
@pytest.mark.parametrize("kind", STILLS + VIDEOS)
def test_exiftool_finds_the_mark(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"file.{kind}"
    file.write_bytes(made(tmp_path, kind))
    command = ["exiftool", "-s3", "-XMP-iptcExt:DigitalSourceType", str(file)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert output.strip() == SourceType.GENERATED


def test_where_the_formats_keep_it(tmp_path: Path) -> None:
    for png in (still("png"), video(tmp_path, "apng")):
        assert 0 < png.index(b"iTXtXML:com.adobe.xmp\0") < png.index(b"IDAT")
    assert b"http://ns.adobe.com/xap/1.0/\0<?xpacket" in still("jpeg")
    webp = still("webp")
    assert webp[12:16] == b"VP8X"
    assert webp[20] & 0x04
    assert b"XMP " in webp


def test_marking_leaves_the_pictures_as_they_are(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (40, 40), colour) for colour in ("red", "lime", "blue")]
    for kind, mark in (("GIF", mark_gif), ("PNG", mark_png)):
        out = BytesIO()
        frames[0].save(out, kind, save_all=True, append_images=frames[1:], duration=100)
        marked = mark(out.getvalue(), SourceType.GENERATED)
        assert read_mark(out.getvalue()) is None
        with Image.open(BytesIO(marked)) as image:
            assert image.n_frames == 3  # type: ignore[attr-defined]
            for number, frame in enumerate(frames):
                image.seek(number)
                assert image.convert("RGB").tobytes() == frame.tobytes()


def test_the_property_as_an_attribute_or_a_resource() -> None:
    packet = xmp_packet(SourceType.GENERATED).decode()
    value = f">{SourceType.GENERATED}</Iptc4xmpExt:DigitalSourceType>"
    resource = packet.replace(value, f' rdf:resource="{SourceType.GENERATED}"/>')
    element = f"<Iptc4xmpExt:DigitalSourceType{value}"
    attribute = packet.replace(element, "").replace(
        'rdf:about=""', f'rdf:about="" Iptc4xmpExt:DigitalSourceType="{SourceType.GENERATED}"'
    )
    for other in (resource, attribute):
        assert other != packet
        out = BytesIO()
        Image.new("RGB", (40, 40)).save(out, "JPEG", xmp=other.encode())
        assert read_mark(out.getvalue()) == SourceType.GENERATED


def test_a_box_with_a_64_bit_size_is_passed() -> None:
    start = struct.pack(">I4s8x", 16, b"ftyp") + struct.pack(">I4sQ4x", 1, b"mdat", 20)
    assert read_mark(start + mp4_box(SourceType.COMPOSITE)) == SourceType.COMPOSITE
    endless = struct.pack(">I4s8x", 16, b"ftyp") + struct.pack(">I4s8x", 0, b"mdat")
    assert read_mark(endless) is None


@pytest.mark.parametrize("kind", STILLS + VIDEOS)
def test_damaged_files_have_no_mark_or_the_right_one(tmp_path: Path, kind: str) -> None:
    data = made(tmp_path, kind)
    for length in range(0, len(data), max(1, len(data) // 200)):
        assert read_mark(data[:length]) in (None, SourceType.GENERATED)


def test_no_mark() -> None:
    out = BytesIO()
    Image.new("RGB", (40, 40)).save(out, "JPEG")
    for data in (b"", b"text", out.getvalue()):
        assert read_mark(data) is None
    for packet in (b"<broken", b'<!DOCTYPE x [<!ENTITY a "b">]><x>&a;</x>', b"<x/>"):
        out = BytesIO()
        Image.new("RGB", (40, 40)).save(out, "JPEG", xmp=packet)
        assert read_mark(out.getvalue()) is None
