"""``cvthead-call``: a camera or a video drives a portrait on a cvthead service."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from cvthead_client import __version__
from cvthead_client.client import Client
from cvthead_client.errors import CVTHeadClientError
from cvthead_client.hello import Hello, Mode, StreamOutput
from cvthead_client.types import AvatarInfo

if TYPE_CHECKING:
    from cvthead_client.driver import Send
    from cvthead_client.media import Captured
    from cvthead_client.stream import Stream

FAILED, INTERRUPTED = 2, 130
WINDOW = "window"


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments like any other error, on one line."""

    def error(self, message: str) -> NoReturn:
        raise CVTHeadClientError(message, hint=f"see {self.prog} --help")


def parser() -> argparse.ArgumentParser:
    result = _Parser(
        "cvthead-call",
        description="Animate a portrait with a camera or a video, over a cvthead service. Animate "
        "only people who agreed.",
    )
    result.add_argument("--version", action="version", version=__version__)
    result.add_argument(
        "source",
        metavar="VIDEO|CAMERA",
        help="a video file, or a camera: its number (0 is the first) or the device's name",
    )
    result.add_argument("--server", default="http://127.0.0.1:8000", metavar="URL")
    result.add_argument("--key", help="API key; better set the variable CVTHEAD_KEY")
    who = result.add_mutually_exclusive_group(required=True)
    who.add_argument(
        "--portrait",
        type=Path,
        metavar="P",
        help="picture of the person to animate; its avatar is deleted after the call",
    )
    who.add_argument("--avatar", metavar="ID", help="an avatar that the service has already")
    result.add_argument("--face", type=int, metavar="N", help="which face of the portrait")
    result.add_argument(
        "--consent", action="store_true", help="state that the person in the portrait agreed"
    )
    what = result.add_mutually_exclusive_group()
    what.add_argument(
        "--coefficients",
        action="store_true",
        help="track the face on this machine and send numbers only; needs the package cvthead "
        "(default where it is installed)",
    )
    what.add_argument(
        "--frames", action="store_true", help="send the driver's pictures to the service"
    )
    result.add_argument(
        "--output",
        default=WINDOW,
        metavar="OUT.mp4|window",
        help="where the result goes (default: a window). A video that is written to a file is "
        "rendered frame by frame, in its own time; all else is live",
    )
    result.add_argument(
        "--relative",
        action="store_true",
        help="add the motion since the first frame to the portrait's own expression and pose",
    )
    result.add_argument("--camera", choices=("source", "driver"), default="source")
    result.add_argument("--background", default="white", metavar="white|#rrggbb|source")
    result.add_argument("--size", type=int, default=256, metavar="N")
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        0; 2 after an error, which is printed on one line; 130 when interrupted.
    """
    try:
        _run(parser().parse_args(argv))
    except CVTHeadClientError as error:
        text = "; ".join(part for part in (str(error).rstrip("."), error.hint) if part)
        print(f"cvthead-call: error: {' '.join(text.split())}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("cvthead-call: interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


def _run(args: argparse.Namespace) -> None:
    try:
        from cvthead_client import driver, media
    except ImportError as error:
        raise CVTHeadClientError(
            f"{error.name} is not installed", hint="pip install 'cvthead-client[video]'"
        ) from error
    if args.output != WINDOW and Path(args.output).suffix.lower() != ".mp4":
        raise CVTHeadClientError(f"cannot write {args.output}", hint="use out.mp4 or window")
    as_numbers = args.coefficients or (not args.frames and driver.can_track())
    if as_numbers and not driver.can_track():
        raise driver.not_installed()
    mode: Mode = "relative" if args.relative else "absolute"
    # Numbers are those of the frame that is wanted; relative motion is worked out here.
    wire_mode: Mode = "absolute" if as_numbers else mode
    output = StreamOutput("jpeg", args.size, args.background, quality=90)
    hello = Hello(output, wire_mode, args.camera)
    is_file = Path(args.source).is_file()
    frames = media.read_video(Path(args.source)) if is_file else media.read_camera(args.source)
    key = args.key or os.environ.get("CVTHEAD_KEY")
    with (
        Client(args.server, key=key) as client,
        _avatar(client, args) as avatar,
        client.stream(avatar.id, hello) as stream,
    ):
        if as_numbers:
            print("tracking here; only numbers are sent", file=sys.stderr)
            follow = args.camera == "driver"
            send: Send = driver.coefficient_sender(stream, avatar, mode, follow=follow)
        else:
            print(f"sending pictures of the driver to {args.server}", file=sys.stderr)
            send = driver.picture_sender(stream)
        if args.output == WINDOW:
            _to_window(frames, send, stream)
        else:
            _to_file(frames, send, stream, Path(args.output), live=not is_file)


@contextmanager
def _avatar(client: Client, args: argparse.Namespace) -> Iterator[AvatarInfo]:
    if args.avatar is not None:
        yield client.get(args.avatar)
        return
    info = client.create(args.portrait, face=args.face, consent=args.consent)
    try:
        yield info
    finally:
        with suppress(CVTHeadClientError):  # gone already, or the service is
            client.delete(info.id)


def _to_file(
    frames: Iterator[Captured], send: Send, stream: Stream, path: Path, *, live: bool
) -> None:
    from cvthead_client.live import Call, step_by_step
    from cvthead_client.media import mp4_writer

    welcome = stream.welcome
    with mp4_writer(path, welcome.output.size, welcome.digital_source_type) as write:
        if live:
            call = Call(frames, send, stream, write)
            call.start()
            print("recording; Ctrl-C ends it", file=sys.stderr)
            try:
                call.wait()
            except KeyboardInterrupt:
                call.stop()
                call.wait()
            print(call.summary(), file=sys.stderr)
        else:
            lost = step_by_step(frames, send, stream, write)
            if lost:
                print(f"no face in {lost} frames; they repeat the one before", file=sys.stderr)
    print(path)


def _to_window(frames: Iterator[Captured], send: Send, stream: Stream) -> None:
    from cvthead_client.live import Call
    from cvthead_client.media import Rgb
    from cvthead_client.window import show

    lock = threading.Lock()
    waiting: list[Rgb] = []

    def shown(image: Rgb, _: float) -> None:
        with lock:
            waiting[:] = [image]

    call = Call(frames, send, stream, shown)

    def newest() -> Rgb | None:
        with lock:
            if waiting:
                return waiting.pop()
        if call.over:
            raise StopIteration
        return None

    call.start()
    try:
        show(newest, lambda: f"cvthead (AI-generated) - {call.summary()}")
    finally:
        call.stop()
    call.wait()


if __name__ == "__main__":
    sys.exit(main())
