"""How every packaged network is opened."""

from __future__ import annotations

import onnxruntime as ort


def open_session(network: bytes, threads: int) -> ort.InferenceSession:
    """A network on the CPU.

    Args:
        network: contents of an ONNX file.
        threads: intra-operator threads, at least 1.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return ort.InferenceSession(network, options, providers=["CPUExecutionProvider"])
