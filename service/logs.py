"""Structured logs on standard error, one line an event, with the request id in each.

Logged are route templates, never paths or queries (an id or a ticket is in them), no headers,
no bodies, no coefficients.
"""

from __future__ import annotations

import logging.config
import sys
from typing import Any

import structlog
from structlog.types import Processor


def configure(level: str, log_format: str) -> None:
    """Send structlog's and the standard library's (uvicorn's) events the same way.

    Args:
        level: "debug", "info", "warning" or "error".
        log_format: "console" or "json".
    """
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    last: list[Any] = (
        [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
        if log_format == "json"
        # Tracebacks with the values of variables would print images and keys.
        else [
            structlog.dev.ConsoleRenderer(
                colors=False, exception_formatter=structlog.dev.plain_traceback
            )
        ]
    )
    # Straight to the stream: the standard library's way there takes twice the time, and every
    # request writes a line.
    structlog.configure(
        processors=[*shared, *last],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.WriteLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    formatter = {
        "()": structlog.stdlib.ProcessorFormatter,
        "foreign_pre_chain": shared,
        "processors": [structlog.stdlib.ProcessorFormatter.remove_processors_meta, *last],
    }
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"structured": formatter},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "structured"}},
            "root": {"handlers": ["stderr"], "level": "WARNING"},
            "loggers": {"uvicorn": {"level": "WARNING"}},
        }
    )
