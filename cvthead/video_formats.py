"""The encoders behind ``video_writer``, one per output format.

Each is a coroutine that writes the file at ``path``: it is started with ``next``, sent (image,
seconds) pairs, and sent None to finish the file. The caller checks sizes and times, handles the
errors of PyAV, and removes what an encoder that was closed early leaves behind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer, OutputContainer
from av.filter import Graph
from av.filter.context import FilterContext
from av.packet import Packet
from av.video.format import VideoFormat
from av.video.frame import VideoFrame
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from numpy.typing import NDArray

from cvthead.errors import VideoError
from cvthead.images import encode_image, on_white
from cvthead.provenance import SourceType, mark_gif, mark_png, mp4_box
from cvthead.video import open_input

Encoder = Generator[None, tuple[NDArray[np.uint8], float] | None, None]


def mp4(
    path: Path,
    size: tuple[int, int],
    rate: Fraction,
    audio_from: Path | str | None,
    source: SourceType,
) -> Encoder:
    clock = Fraction(1, 90_000)
    width, height = size
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as output:
        # For players that show no XMP.
        output.metadata["comment"] = f"AI-generated: {source}"
        options = {"preset": "veryfast", "crf": "18"}
        stream = output.add_stream("libx264", rate=rate, options=options)
        stream.width, stream.height = width + width % 2, height + height % 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = clock
        # Players guess the colour matrix from the size where the file does not say it.
        stream.color_primaries, stream.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        stream.colorspace, stream.color_range = Colorspace.ITU709, ColorRange.MPEG
        sound = _sound(output, audio_from) if audio_from is not None else iter(())
        packet = next(sound, None)
        end = 0.0
        while (item := (yield)) is not None:
            image, time = item
            padded = np.pad(on_white(image), padding, mode="edge")
            frame = _frame(padded, time, clock).reformat(
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
            )
            frame.duration = round(1 / rate / clock)
            output.mux(stream.encode(frame))
            end = time + float(1 / rate)
            # Side by side with the pictures, so that a player need not seek between the two.
            packet = _mux_until(output, sound, packet, end)
        output.mux(stream.encode(None))
    with path.open("ab") as file:
        file.write(mp4_box(source))


def gif(path: Path, size: tuple[int, int], rate: Fraction, source: SourceType) -> Encoder:
    width, height = size
    clock = Fraction(1, 100)  # GIF counts in hundredths of a second
    statistics = Graph()
    colours = _buffer(statistics, size, "rgb24", clock)
    _chain(statistics, [colours], "palettegen")
    times: list[float] = []
    # The palette is known only after the last frame; on disk the frames need no memory.
    with tempfile.TemporaryFile() as frames:
        while (item := (yield)) is not None:
            image, time = item
            if times and round(time / clock) - round(times[-1] / clock) < 2:
                continue
            times.append(time)
            rgb = on_white(image)
            frames.write(rgb.tobytes())
            colours.push(_frame(rgb, time, clock))
        colours.push(None)
        palette = statistics.vpull()

        drawing = Graph()
        pictures = _buffer(drawing, size, "rgb24", clock)
        table = _buffer(drawing, (16, 16), "bgra", clock)
        _chain(drawing, [pictures, table], "paletteuse", "diff_mode=rectangle")
        table.push(palette)
        table.push(None)
        frames.seek(0)
        with av.open(str(path), "w", format="gif", options={"loop": "0"}) as output:
            stream = output.add_stream("gif", rate=rate)
            stream.width, stream.height, stream.pix_fmt = width, height, "pal8"
            stream.codec_context.time_base = clock
            for time in times:
                raw = np.frombuffer(frames.read(width * height * 3), np.uint8)
                pictures.push(_frame(raw.reshape(height, width, 3), time, clock))
                output.mux(stream.encode(drawing.vpull()))
            output.mux(stream.encode(None))
    path.write_bytes(mark_gif(path.read_bytes(), source))


def apng(path: Path, size: tuple[int, int], rate: Fraction, source: SourceType) -> Encoder:
    clock = Fraction(1, 1000)
    with av.open(str(path), "w", format="apng", options={"plays": "0"}) as output:
        stream = output.add_stream("apng", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "rgba"
        stream.codec_context.time_base = clock
        while (item := (yield)) is not None:
            image, time = item
            if image.shape[2] == 3:
                image = np.pad(image, ((0, 0), (0, 0), (0, 1)), constant_values=255)
            output.mux(stream.encode(_frame(image, time, clock)))
        output.mux(stream.encode(None))
    path.write_bytes(mark_png(path.read_bytes(), source))


def folder(path: Path, source: SourceType) -> Encoder:
    count = 0
    while (item := (yield)) is not None:
        data = encode_image(item[0], "png", source=source)
        (path / f"{count:06d}.png").write_bytes(data)
        count += 1


def _frame(image: NDArray[np.uint8], time: float, clock: Fraction) -> VideoFrame:
    layout = "rgb24" if image.shape[2] == 3 else "rgba"
    frame = VideoFrame.from_ndarray(np.ascontiguousarray(image), format=layout)
    frame.time_base, frame.pts = clock, round(time / clock)
    return frame


def _buffer(graph: Graph, size: tuple[int, int], layout: str, clock: Fraction) -> FilterContext:
    return graph.add_buffer(
        width=size[0], height=size[1], format=VideoFormat(layout), time_base=clock
    )


def _chain(graph: Graph, inputs: list[FilterContext], name: str, options: str = "") -> None:
    """Connects ``inputs`` with the filter ``name`` and that with the graph's output."""
    step = graph.add(name, options)
    for number, buffer in enumerate(inputs):
        buffer.link_to(step, 0, number)
    step.link_to(graph.add("buffersink"))
    graph.configure()


def _mux_until(
    output: OutputContainer,
    packets: Iterator[Packet[AudioStream]],
    packet: Packet[AudioStream] | None,
    end: float,
) -> Packet[AudioStream] | None:
    """Mux ``packet`` and those after it that start before ``end``; the first one that does not."""
    while packet is not None and (packet.dts or 0) * packet.time_base < end:
        output.mux(packet)
        packet = next(packets, None)
    return packet


def _sound(output: OutputContainer, path: Path | str) -> Iterator[Packet[AudioStream]]:
    """Adds a sound track to ``output`` and yields its AAC packets; none without sound.

    Times count from the start of the file at ``path``, like those of ``read_frames``.
    """
    with open_input(path) as container:
        # Phones add tracks in formats that have no decoder here beside the plain one.
        tracks = [track for track in container.streams.audio if track.codec_context is not None]
        if not tracks:
            return
        track = tracks[0]
        start = Fraction(container.start_time or 0, av.time_base)
        # Without its header (extradata) AAC cannot be put into MP4.
        if track.codec_context.name == "aac" and track.codec_context.extradata:
            yield from _copied(container, track, output.add_stream_from_template(track), start)
        else:
            # A rate and a layout that every browser plays.
            encoder = output.add_stream("aac", rate=48_000, layout="stereo")
            yield from _converted(container, track, encoder, start)


def _copied(
    container: InputContainer, track: AudioStream, out: AudioStream, start: Fraction
) -> Iterator[Packet[AudioStream]]:
    for packet in container.demux(track):
        if packet.dts is None or packet.pts is None:  # the flush packet at the end
            continue
        shift = round(start / packet.time_base)
        packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, out
        yield packet


def _converted(
    container: InputContainer, track: AudioStream, out: AudioStream, start: Fraction
) -> Iterator[Packet[AudioStream]]:
    layout = None
    for frame in container.decode(track):
        if layout not in (None, (frame.format.name, frame.layout.name, frame.sample_rate)):
            raise VideoError(
                "the sound changes its format on the way",
                hint="Leave the sound out, or convert the video first.",
            )
        layout = frame.format.name, frame.layout.name, frame.sample_rate
        if frame.time is not None:
            # Counted in samples: a container's own clock can be coarser than an AAC frame.
            frame.pts = round((frame.time - start) * frame.sample_rate)
            frame.time_base = Fraction(1, frame.sample_rate)
        yield from out.encode(frame)
    yield from out.encode(None)
