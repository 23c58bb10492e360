"""How every packaged network is opened."""

from __future__ import annotations

import onnxruntime as ort


def open_session(network: bytes | str, threads: int) -> ort.InferenceSession:
    """A network on the CPU.

    Args:
        network: contents of an ONNX file, or its path.
        threads: intra-operator threads, at least 1.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Threads that wait for the next run would take a core from whatever handles the result.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    return ort.InferenceSession(network, options, providers=["CPUExecutionProvider"])
