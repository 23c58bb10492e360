"""Prometheus metrics. Base units (seconds, bytes); never a label with an unbounded set of values.

Avatar ids, keys and addresses are no labels; routes are labelled by their template.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    Info,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from cvthead.cache import AvatarCache

__all__ = ["CONTENT_TYPE_LATEST", "CacheCollector", "Metrics", "Queue"]

Queue = Literal["encode", "render"]

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)
BATCHES = (1, 2, 4, 8, 16, 32, 64)


class Metrics:
    """The metrics of one service, in a registry of their own."""

    def __init__(self) -> None:
        registry = self.registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        self.build = Info("cvthead_build", "Version, preset and weights.", registry=registry)
        self.requests = Counter(
            "cvthead_requests",
            "HTTP requests by route template, method and status.",
            ["route", "method", "status"],
            registry=registry,
        )
        self.request_seconds = Histogram(
            "cvthead_request_seconds",
            "Time from a request's headers to the end of its answer.",
            ["route"],
            buckets=SECONDS,
            registry=registry,
        )
        self.in_flight = Gauge(
            "cvthead_requests_in_flight", "Requests being answered.", registry=registry
        )
        self.problems = Counter(
            "cvthead_problems", "Problems answered, by code.", ["code"], registry=registry
        )
        self.queue_seconds = Histogram(
            "cvthead_queue_seconds",
            "Time that work waited in a queue.",
            ["queue"],
            buckets=SECONDS,
            registry=registry,
        )
        self.queue_depth = Gauge(
            "cvthead_queue_depth", "Work waiting in a queue.", ["queue"], registry=registry
        )
        self.stage_seconds = Histogram(
            "cvthead_stage_seconds",
            "Time of one stage of the work: encode, track, pose, paint, image, ...",
            ["stage"],
            buckets=SECONDS,
            registry=registry,
        )
        self.batch_size = Histogram(
            "cvthead_batch_size", "Renders painted at once.", buckets=BATCHES, registry=registry
        )
        self.overloaded = Counter(
            "cvthead_overloaded",
            "Work refused because a queue was full.",
            ["queue"],
            registry=registry,
        )
        self.cancelled = Counter(
            "cvthead_cancelled",
            "Work skipped because its client had gone.",
            ["queue"],
            registry=registry,
        )
        self.stored_avatars = Gauge(
            "cvthead_stored_avatars", "Avatars in the store.", registry=registry
        )
        self.streams = Gauge("cvthead_streams", "Open WebSocket streams.", registry=registry)
        self.stream_frames = Counter(
            "cvthead_stream_frames",
            "Frames of streams: received, rendered, dropped, lost_face.",
            ["event"],
            registry=registry,
        )
        # Series that are there from the start can be alerted on before the first event.
        for queue in ("encode", "render"):
            self.queue_depth.labels(queue)
            self.overloaded.labels(queue)
            self.cancelled.labels(queue)
        for event in ("received", "rendered", "dropped", "lost_face"):
            self.stream_frames.labels(event)

    def text(self) -> bytes:
        """The metrics in Prometheus' text format."""
        return generate_latest(self.registry)


class CacheCollector(Collector):
    """Reads the cache's own counters when the metrics are asked for."""

    def __init__(self, cache: AvatarCache) -> None:
        self._cache = cache

    def collect(self) -> Iterator[Metric]:
        cache = self._cache
        yield CounterMetricFamily("cvthead_cache_hits", "Avatars found in memory.", cache.hits)
        yield CounterMetricFamily("cvthead_cache_misses", "Avatars read from disk.", cache.misses)
        yield CounterMetricFamily(
            "cvthead_cache_evictions", "Avatars that left the memory for others.", cache.evictions
        )
        yield GaugeMetricFamily(
            "cvthead_cache_bytes", "Bytes of avatars held in memory.", cache.used_bytes
        )
