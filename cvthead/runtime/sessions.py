"""How every packaged network is opened."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import onnxruntime as ort

from cvthead.errors import AssetError

CPU = ("CPUExecutionProvider",)


def open_session(
    network: bytes | str, threads: int, providers: Sequence[str] = CPU, *, niceness: int = 0
) -> ort.InferenceSession:
    """A network, ready to run.

    Args:
        network: contents of an ONNX file, or its path.
        threads: intra-operator threads, at least 1.
        providers: onnxruntime's execution providers in the order of preference, such as
            "CUDAExecutionProvider"; what they cannot run, the CPU does.
        niceness: lowers the priority of the threads that help the caller of a run (Linux); the
            caller's own is not touched.

    Raises:
        AssetError: the installed onnxruntime lacks a provider.
    """
    available = ort.get_available_providers()
    for provider in providers:
        if provider not in available:
            raise AssetError(
                f"onnxruntime has no {provider}",
                hint=f"use one of {', '.join(available)}, or install another build of onnxruntime",
            )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Threads that wait for the next run would take a core from whatever handles the result.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if not niceness:
        return ort.InferenceSession(network, options, providers=list(providers))
    # The helpers begin here and inherit the priority of the thread that opens the session.
    with ThreadPoolExecutor(1, initializer=lower_priority, initargs=(niceness,)) as opener:
        return opener.submit(
            ort.InferenceSession, network, options, providers=list(providers)
        ).result()


def lower_priority(niceness: int) -> None:
    """Lower the calling thread's priority, and that of threads it starts from now on.

    Linux only: elsewhere a priority belongs to the whole process.

    Args:
        niceness: added to the thread's own; 0 changes nothing.
    """
    if niceness and sys.platform == "linux":
        os.nice(niceness)
