"""What an installation weighs and what a service needs: ``python -m tools.footprint``.

Prints the megabytes of wheels that a base installation downloads (they are downloaded from PyPI
into a temporary folder), the seconds from the start of ``cvthead serve`` until ``/health/ready``
answers 200, and the resident memory of the service then, after 200 renders, and at its highest.
With ``--preset official`` of the imported model, without the download. Linux only, on a quiet
machine. MB are millions of bytes.
"""

from __future__ import annotations

import argparse
import http.client
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from cvthead.official.manifest import FOLDER_VARIABLE
from cvthead.preset import PRESETS
from service.load import Target, render, upload

ROOT = Path(__file__).parents[1]
PORTRAIT = ROOT / "examples" / "astronaut.png"
RENDERS = 200
PICTURE_PIXELS = 256
POLL_SECONDS, START_SECONDS, STOP_SECONDS = 0.02, 120.0, 60.0


def base_dependencies() -> list[str]:
    """Requirements of the package without extras, as pyproject.toml has them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return [str(requirement) for requirement in project["dependencies"]]


def wheels(folder: Path) -> list[Path]:
    """Download the base dependencies and all that they need into a folder.

    Raises:
        subprocess.CalledProcessError: pip failed; it has said why.
    """
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-cache-dir"]
    command = [*pip, "--only-binary", ":all:", "--dest", str(folder), *base_dependencies()]
    subprocess.run(command, check=True)
    return sorted(folder.glob("*.whl"))


def resident_bytes(process: int, figure: str = "VmRSS") -> int:
    """Resident memory of a process by its id, as Linux names it; ``VmHWM`` is the highest."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith(f"{figure}:"):
            return int(line.split()[1]) * 1024
    raise ProcessLookupError(f"process {process} has ended")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def is_ready(port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", "/health/ready")
        return connection.getresponse().status == 200
    except OSError:
        return False
    finally:
        connection.close()


def service_lines(folder: Path, preset: str, renders: int) -> list[str]:
    """Start a service with its store in ``folder``, let it render, stop it.

    Raises:
        SystemExit: it ends early or does not become ready.
    """
    port = free_port()
    # Settings of this shell or folder must not change what is measured.
    environment = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith("CVTHEAD_") or key == FOLDER_VARIABLE
    }
    command = [sys.executable, "-m", "cvthead.cli.main", "serve", "--log-level", "warning"]
    begin = time.perf_counter()
    with subprocess.Popen(
        [*command, "--preset", preset, "--port", str(port), "--store", str(folder)],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
    ) as service:
        try:
            while not is_ready(port):
                if service.poll() is not None or time.perf_counter() - begin > START_SECONDS:
                    raise SystemExit("the service did not become ready")
                time.sleep(POLL_SECONDS)
            seconds = time.perf_counter() - begin
            fresh = resident_bytes(service.pid)
            render_many(f"http://127.0.0.1:{port}", renders)
            used, highest = (resident_bytes(service.pid, name) for name in ("VmRSS", "VmHWM"))
        finally:
            service.terminate()
            service.wait(STOP_SECONDS)
    return [
        f"service ready after {seconds:.1f} s",
        f"resident when ready: {fresh / 1e6:.0f} MB",
        f"resident after one upload and {renders} renders: {used / 1e6:.0f} MB",
        f"highest: {highest / 1e6:.0f} MB",
    ]


def render_many(url: str, count: int) -> None:
    """Upload the sample portrait and render ``count`` frames of it.

    Raises:
        SystemExit: a render failed.
    """
    target, chance = Target(url, key=""), random.Random(0)
    avatar = upload(target, PORTRAIT)
    for _ in range(count):
        answer = render(target, avatar, chance, "image/png", PICTURE_PIXELS)
        if answer.status != 200:
            raise SystemExit(f"a render was answered {answer.status}")
    target.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--renders", type=int, default=RENDERS, help="(200)")
    parser.add_argument("--preset", choices=PRESETS, default="open", help="(open)")
    arguments = parser.parse_args()
    if arguments.preset == "open":
        with tempfile.TemporaryDirectory() as folder:
            found = wheels(Path(folder))
            size = sum(wheel.stat().st_size for wheel in found)
            print(f"base installation: {size / 1e6:.0f} MB in {len(found)} wheels", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        print("\n".join(service_lines(Path(folder), arguments.preset, arguments.renders)))


if __name__ == "__main__":
    main()
