"""The mark that says a picture is AI-generated, in every format this package writes.

The mark is the IPTC property DigitalSourceType (IPTC Photo Metadata Standard 2023.1, section
"Digital Source Type") in an XMP packet (ISO 16684-1), embedded as XMP Specification Part 3
prescribes: PNG and animated PNG in an iTXt chunk, JPEG in an APP1 segment, WebP in an "XMP "
chunk, GIF in an application extension, MP4 in a top-level uuid box.
"""

from __future__ import annotations

import struct
import zlib
from enum import StrEnum
from io import BytesIO
from uuid import UUID
from xml.etree import ElementTree

from PIL import Image

PNG_KEYWORD = "XML:com.adobe.xmp"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_END = 33  # signature 8, IHDR 12 + 13
_GIF_EXTENSION = b"\x21\xff\x0bXMP DataXMP"
# A GIF reader that does not know the extension takes the packet's bytes for block lengths; from
# wherever it lands, this run leads it to the terminating zero (XMP Part 3, section 1.1.2).
_GIF_TRAILER = b"\x01" + bytes(range(255, -1, -1)) + b"\x00"
_MP4_UUID = UUID("be7acfcb-97a9-42e8-9c71-999491e3afac").bytes
_IPTC_EXTENSION = "http://iptc.org/std/Iptc4xmpExt/2008-02-29/"


class SourceType(StrEnum):
    """Values of DigitalSourceType (https://cv.iptc.org/newscodes/digitalsourcetype/)."""

    GENERATED = "http://cv.iptc.org/newscodes/digitalsourcetype/trainedAlgorithmicMedia"
    COMPOSITE = (
        "http://cv.iptc.org/newscodes/digitalsourcetype/compositeWithTrainedAlgorithmicMedia"
    )


def xmp_packet(source: SourceType) -> bytes:
    """The XMP packet (UTF-8) that carries ``source``."""
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about=""'
        f' xmlns:Iptc4xmpExt="{_IPTC_EXTENSION}"'
        ' xmlns:xmp="http://ns.adobe.com/xap/1.0/">'
        "<xmp:CreatorTool>cvthead</xmp:CreatorTool>"
        f"<Iptc4xmpExt:DigitalSourceType>{source}</Iptc4xmpExt:DigitalSourceType>"
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
        '<?xpacket end="r"?>'
    ).encode()


def mark_png(data: bytes, source: SourceType) -> bytes:
    """A PNG or animated PNG file with the mark added before its pixels."""
    # iTXt: keyword, not compressed, no language, no translated keyword, text.
    body = b"iTXt" + PNG_KEYWORD.encode() + bytes(5) + xmp_packet(source)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:_PNG_HEADER_END] + chunk + data[_PNG_HEADER_END:]


def mark_gif(data: bytes, source: SourceType) -> bytes:
    """A GIF file with the mark added before its first picture."""
    flags = data[10]
    start = 13 + (3 * 2 ** ((flags & 7) + 1) if flags & 0x80 else 0)  # after the colour table
    extension = _GIF_EXTENSION + xmp_packet(source) + _GIF_TRAILER
    # Only version 89a knows extensions.
    return b"GIF89a" + data[6:start] + extension + data[start:]


def mp4_box(source: SourceType) -> bytes:
    """The box to append to an MP4 file; at its end it moves no sample offset."""
    body = b"uuid" + _MP4_UUID + xmp_packet(source)
    return struct.pack(">I", len(body) + 4) + body


def read_mark(data: bytes) -> str | None:
    """The DigitalSourceType that a file carries.

    Args:
        data: a whole PNG, JPEG, WebP, GIF or MP4 file, from this package or another source.

    Returns:
        The property's value, a URI (``SourceType`` for the files of this package); None without
        one, and for bytes that are no such file.
    """
    packet = _packet(data)
    # A document type is not allowed in XMP, and entities in one could exhaust the memory.
    if packet is None or b"<!" in packet:
        return None
    try:
        root = ElementTree.fromstring(packet.strip(b"\x00 "))
    except ElementTree.ParseError:
        return None
    name = f"{{{_IPTC_EXTENSION}}}DigitalSourceType"
    for element in root.iter():
        if name in element.attrib:
            return element.attrib[name]
        if element.tag == name:
            resource = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}resource"
            return element.get(resource) or (element.text or "").strip() or None
    return None


def _packet(data: bytes) -> bytes | None:
    if data.startswith(b"GIF8"):
        return _gif_packet(data)
    if data[4:8] == b"ftyp":
        return _mp4_packet(data)
    try:
        with Image.open(BytesIO(data), formats=("PNG", "JPEG", "WEBP")) as image:
            packet = image.info.get("xmp")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None
    return packet if isinstance(packet, bytes) else None


def _gif_packet(data: bytes) -> bytes | None:
    start = data.find(_GIF_EXTENSION)
    end = data.find(_GIF_TRAILER, start)
    return data[start + len(_GIF_EXTENSION) : end] if 0 <= start < end else None


def _mp4_packet(data: bytes) -> bytes | None:
    position = 0
    while position + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, position)
        header = 8
        if size == 1 and position + 16 <= len(data):  # the size follows in 64 bits
            (size,) = struct.unpack_from(">Q", data, position + 8)
            header = 16
        if kind == b"uuid" and data.startswith(_MP4_UUID, position + header):
            return data[position + header + 16 : position + size]
        if size < header:  # 0: the box reaches to the end of the file
            return None
        position += size
    return None
