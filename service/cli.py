"""``cvthead serve``: the service on one address, until Ctrl-C or SIGTERM."""

from __future__ import annotations

import argparse
import shlex
import socket
from pathlib import Path

from cvthead.errors import InputError
from cvthead.sample import SAMPLE


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "serve",
        help="run the HTTP service and the page",
        description="Run the HTTP service and the page until Ctrl-C or SIGTERM.",
        epilog="Everything else is set by CVTHEAD_... variables or a file: docs/service.md.",
    )
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port, 0 = a free one (default: 8000)")
    parser.add_argument("--store", type=Path, help="folder of the avatars (default: avatars)")
    parser.add_argument("--preset", help="model to use: open (default) or official")
    parser.add_argument("--model", type=Path, help="folder of another model of the preset")
    parser.add_argument("--threads", type=int, help="threads of each network (default: the cores)")
    parser.add_argument("--log-level", help="debug, info, warning or error (default: info)")
    parser.add_argument("--log-format", help="console or json (default: console)")
    parser.add_argument(
        "--open-network",
        action="store_true",
        default=None,
        help="listen beyond loopback although no keys are set",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    try:
        from service.server import serve
        from service.settings import load_settings
    except ModuleNotFoundError as error:
        raise InputError(
            f"the service needs the package {error.name}",
            hint="install cvthead with its dependencies: `pip install cvthead`",
        ) from error
    options = (
        "host",
        "port",
        "store",
        "preset",
        "model",
        "threads",
        "log_level",
        "log_format",
        "open_network",
    )
    settings = load_settings(**{name: getattr(args, name) for name in options})
    with listening(settings.host, settings.port) as bound:
        serve(settings, bound, banner(settings.host, bound.getsockname()[1], bool(settings.keys)))


def listening(host: str, port: int) -> socket.socket:
    """A bound socket; bound before the model is loaded, so that a taken port is told at once.

    Raises:
        InputError: unknown address, or taken port.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP)
        # asyncio switches Nagle's algorithm, which costs 40 ms per answer, off only where the
        # socket names its protocol.
        family, kind, protocol, _, address = found[0]
        bound = socket.socket(family, kind, protocol)
        try:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
        except OSError:
            bound.close()
            raise
    except OSError as error:
        raise InputError(
            f"cannot listen on {host}, port {port}: {error.strerror}",
            hint="choose another --host or --port",
        ) from error
    return bound


def banner(host: str, port: int, with_keys: bool) -> str:
    """What to do next, to be pasted into a shell."""
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    url = f"http://{shown}:{port}"
    key = ' -H "Authorization: Bearer $KEY"' if with_keys else ""
    portrait = shlex.quote(str(SAMPLE))
    motion = """-H 'Content-Type: application/json' -d '{"arkit": {"jawOpen": 0.6}}'"""
    first = "grep -oE '[0-9a-f]{32}' | head -n 1"
    lines = [
        f"cvthead is ready: open {url}/ in a browser, or try",
        "",
        *(["  KEY=...  # one of the keys"] if with_keys else []),
        f"  ID=$(curl -s{key} -F image=@{portrait} -F consent=true {url}/v1/avatars | {first})",
        f"  curl -s{key} {motion} -o frame.png {url}/v1/avatars/$ID/render",
        "",
        "Stop it with Ctrl-C.",
    ]
    return "\n".join(lines)
