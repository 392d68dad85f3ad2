"""Metrics for Prometheus: read from the service when they are scraped, so that nothing is counted twice."""

from __future__ import annotations

import time
from collections import Counter as TotalCounter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ConfigError
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.metrics import write_asset_series
from servoscope.service.health import alarm_gauge
from servoscope.service.layer_times import LayerTimes
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import Rejection
from servoscope.service.writer import StoreWriter

if TYPE_CHECKING:
    from prometheus_client.core import Metric


BUCKETS_S = tuple(float(f"{base}e{power}") for power in (-3, -2, -1, 0, 1) for base in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))


class MetricsContext(Protocol):
    """What the metrics read of a service."""

    assets: dict[str, Asset]
    sources: dict[str, Inbox]
    writer: StoreWriter
    layers: LayerTimes
    last_turn: float  # when it last polled its sources, by the monotonic clock [s]

    @property
    def troubles(self) -> Mapping[str, str]:
        """What is wrong with the connection of each source and outlet, in words, by its name; empty: nothing."""


class ServiceMetrics:
    """The metrics of one service; counts of assets are those of their checkpoints, and continue over restarts."""

    def __init__(self, service: MetricsContext) -> None:
        try:
            from prometheus_client import CollectorRegistry, Counter, Histogram
        except ModuleNotFoundError:
            raise ConfigError("prometheus-client is missing, pip install 'servoscope[service]'") from None
        self._service, self.registry = service, CollectorRegistry()

        def histogram(name: str, text: str) -> Histogram:
            return Histogram(f"servoscope_{name}_seconds", text, buckets=BUCKETS_S, registry=self.registry)

        def counter(name: str, text: str, labels: Sequence[str] = ()) -> Counter:
            return Counter(f"servoscope_{name}", text, labelnames=labels, registry=self.registry)

        self.failures = counter("store_failures", "Attempts to store that failed")
        # of blocks: how many in each bin, and their sum [s]; one by one they would take longer than a kernel
        self._latencies = np.zeros(len(BUCKETS_S) + 1, dtype=np.int64), 0.0
        self._commits = histogram("commit", "Duration of a commit")
        self._alarms = TotalCounter[tuple[str, str, str]]()  # that are not normal, by name, priority and state
        self._render_s = 0.0  # processor time of `render` so far [s]
        self._rejections = counter("refused", "Messages that could not be used", ["source", "asset", "kind"])
        self.registry.register(self)  # calls `collect`

    def record_commit(self, latencies: FloatArray, seconds: float) -> None:
        """Count a commit of blocks with these latencies [s], shape (N,), which took so long [s]."""
        self._commits.observe(seconds)
        places = np.bincount(np.searchsorted(BUCKETS_S, latencies), minlength=len(BUCKETS_S) + 1)
        self._latencies = self._latencies[0] + places, self._latencies[1] + float(latencies.sum())

    def record_rejection(self, source: str, one: Rejection) -> None:
        """Count messages that could not be used."""
        self._rejections.labels(source, one.asset, one.kind).inc(one.count)

    def render(self) -> bytes:
        """Return all of them in the format of Prometheus."""
        from prometheus_client import generate_latest

        start = time.thread_time()
        series = write_asset_series(self._service.assets)
        self._alarms = series.alarms
        text = generate_latest(self.registry) + series.text.encode()
        self._render_s += time.thread_time() - start
        return text

    def collect(self) -> Iterator[Metric]:
        """Yield what is read from the service."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
        from prometheus_client.utils import floatToGoString

        service = self._service
        trouble = GaugeMetricFamily(
            "servoscope_connection_trouble", "Whether something is wrong with a source or outlet", labels=["name"]
        )
        intervals = GaugeMetricFamily(
            "servoscope_update_interval_seconds", "Between two values of a signal", labels=["source", "asset", "signal"]
        )
        for name, source in service.sources.items():
            for (asset_name, signal), interval in source.update_intervals_s.items():
                intervals.add_metric([name, asset_name, signal], interval)
        for name, why in service.troubles.items():
            trouble.add_metric([name], float(bool(why)))
        layers = CounterMetricFamily("servoscope_processor_seconds", "Processor time by layer", labels=["layer"])
        shares = TotalCounter({**service.layers.seconds, "metrics": self._render_s})
        for source in service.sources.values():
            shares.update(source.transport.layer_seconds)
        for layer, seconds in shares.items():
            layers.add_metric([layer], seconds)
        up = GaugeMetricFamily("servoscope_source_up", "Whether a source is connected", labels=["source"])
        for name, source in service.sources.items():
            up.add_metric([name], float(source.connected))
        places, total = self._latencies
        edges = [*map(floatToGoString, BUCKETS_S), "+Inf"]
        latency = HistogramMetricFamily("servoscope_latency_seconds", "Last sample of a block to its results stored")
        latency.add_metric([], list(zip(edges, np.cumsum(places).tolist(), strict=True)), total)
        yield from (
            latency,
            layers,
            trouble,
            intervals,
            alarm_gauge(self._alarms),
            up,
        )
        for name, words, value in (
            ("store_up", "Whether the last attempt to store succeeded", service.writer.unavailable_since is None),
            ("buffered_blocks", "Blocks that wait to be stored", service.writer.waiting),
            ("buffer_blocks", "How many may wait", service.writer.capacity),
            ("last_turn_age_seconds", "Since the service last looked for blocks", time.monotonic() - service.last_turn),
        ):
            yield GaugeMetricFamily(f"servoscope_{name}", words, value=float(value))
