"""The service as a real process on a socket."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

ROOT = Path(__file__).parents[2]
PORTRAIT = ROOT / "examples" / "astronaut.png"
# Loading and the first render take long on a busy machine.
START_SECONDS = 240
STOP_SECONDS = 120


@dataclass(eq=False)
class Server:
    """A running ``cvthead serve``."""

    process: subprocess.Popen[str]
    url: str
    store: Path
    output: list[str]
    log_file: Path

    @property
    def host(self) -> str:
        return self.url.removeprefix("http://")

    def client(self, key: str | None = None) -> httpx.Client:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx.Client(base_url=self.url, headers=headers, timeout=120)

    def logs(self) -> str:
        """What the process wrote to standard error so far."""
        return self.log_file.read_text()

    def terminate(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def wait(self) -> int:
        """Exit status."""
        return self.process.wait(STOP_SECONDS)


@contextmanager
def start_server(folder: Path, **settings: object) -> Iterator[Server]:
    """Run ``cvthead serve`` on a free port with these settings (``rate_limit=3``).

    Args:
        folder: for the log; the store is ``folder/store`` unless ``store=`` says otherwise. Used
            again it tests what survives a restart.
    """
    folder.mkdir(parents=True, exist_ok=True)
    store = Path(str(settings.setdefault("store", folder / "store")))
    settings = {"rate_limit": 0, "drain_seconds": 100, "log_format": "json", **settings}
    environment = {k: v for k, v in os.environ.items() if not k.startswith("CVTHEAD_")}
    environment |= {f"CVTHEAD_{name.upper()}": str(value) for name, value in settings.items()}
    log_file = folder / f"server-{time.monotonic_ns()}.log"
    with log_file.open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "cvthead.cli.main", "serve", "--port", "0"],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    output: list[str] = []
    try:
        yield Server(process, _address(process, output, log_file), store, output, log_file)
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        assert process.stdout is not None
        process.stdout.close()


def _address(process: subprocess.Popen[str], output: list[str], log_file: Path) -> str:
    """The address that the process prints when it is ready; all it prints is in ``output``."""
    assert process.stdout is not None
    deadline = threading.Timer(START_SECONDS, process.kill)
    deadline.start()
    try:
        for line in process.stdout:
            output.append(line)
            if "Stop it with" in line:
                break
    finally:
        deadline.cancel()
    found = re.search(r"http://[^/\s]+", "".join(output))
    assert found, f"the server did not start:\n{log_file.read_text()}"
    ready = httpx.get(f"{found[0]}/health/ready", timeout=60)
    assert ready.status_code == 200, ready.text
    return found[0]
