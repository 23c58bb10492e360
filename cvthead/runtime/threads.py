"""Who may use how many cores."""

from __future__ import annotations

import os

import cv2
from threadpoolctl import threadpool_limits


def cores() -> int:
    """Cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # Linux alone has it
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def one_thread_per_call() -> None:
    """Keep NumPy's and OpenCV's own pools to one thread for the rest of the process.

    Their work per frame is a fraction of a millisecond; a pool's idle threads spin on the cores
    that onnxruntime's networks need, which made a solve ten times slower. Called by the programs
    (command line, service), not by the library.
    """
    threadpool_limits(limits=1, user_api="blas")
    cv2.setNumThreads(1)
