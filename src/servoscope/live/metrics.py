"""What Prometheus is told: read from the service when it asks, so that nothing is counted twice."""

from __future__ import annotations

import time
from collections import Counter as Tally
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from servoscope.errors import ConfigError

if TYPE_CHECKING:
    from prometheus_client.core import Metric

    from servoscope.live.refusals import Refusal
    from servoscope.live.service import Service

__all__ = ["Metrics"]

SECONDS = tuple(float(f"{base}e{power}") for power in (-3, -2, -1, 0, 1) for base in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))
COUNTED = {
    "blocks": "Blocks that were counted",
    "samples": "Samples that were counted",
    "lost": "Blocks that never came",
    "repeated": "Blocks that came once more and were left out",
}


class Metrics:
    """The metrics of one service.

    Counts of assets are those of their checkpoints: they go on over restarts.

    Parameters
    ----------
    service
        Whose they are.
    """

    def __init__(self, service: Service) -> None:
        try:
            from prometheus_client import CollectorRegistry, Counter, Histogram
        except ModuleNotFoundError:
            raise ConfigError("prometheus-client is missing, pip install 'servoscope[service]'") from None
        self._service = service
        self.registry = CollectorRegistry()
        registry = self.registry
        self.failures = Counter("servoscope_store_failures", "Attempts to store that failed", registry=registry)
        self._latency = Histogram(
            "servoscope_latency_seconds",
            "Last sample of a block to its results stored",
            buckets=SECONDS,
            registry=registry,
        )
        self._commits = Histogram(
            "servoscope_commit_seconds", "Duration of a commit", buckets=SECONDS, registry=registry
        )
        labels = ["source", "asset", "kind"]
        self._refused = Counter(
            "servoscope_refused", "Messages that could not be used", labelnames=labels, registry=registry
        )
        registry.register(self)  # whatever has a method collect

    def committed(self, latencies: Sequence[float], seconds: float) -> None:
        """Take note of a commit."""
        self._commits.observe(seconds)
        for latency in latencies:
            self._latency.observe(latency)

    def refused(self, source: str, one: Refusal) -> None:
        """Take note of messages that could not be used."""
        self._refused.labels(source, one.asset, one.kind).inc(one.number)

    def text(self) -> bytes:
        """Return all of them as Prometheus reads them."""
        from prometheus_client import generate_latest

        return generate_latest(self.registry)

    def collect(self) -> Iterator[Metric]:
        """Yield what is read from the service."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        statuses = [
            (name, asset.progress, asset.status(asset.progress))
            for name, asset in self._service.assets.items()
            if asset.progress is not None
        ]
        for key, words in COUNTED.items():
            family = CounterMetricFamily(f"servoscope_{key}", words, labels=["asset"])
            for name, progress, _ in statuses:
                family.add_metric([name], getattr(progress.counted, key))
            yield family
        last = GaugeMetricFamily("servoscope_last_sample_time_seconds", "Time of the last sample", labels=["asset"])
        verdict = GaugeMetricFamily("servoscope_verdict", "1 for the verdict that holds", labels=["asset", "verdict"])
        alarms: Tally[tuple[str, str, str]] = Tally()
        for name, progress, status in statuses:
            last.add_metric([name], progress.counted.t)
            verdict.add_metric([name, status["verdict"]], 1.0)
            for alarm, one in status["alarms"].items():
                alarms[alarm, one["priority"], one["state"]] += 1
        standing = GaugeMetricFamily(
            "servoscope_alarms", "Alarms that are not normal", labels=["alarm", "priority", "state"]
        )
        for labels, count in alarms.items():
            standing.add_metric(list(labels), count)
        up = GaugeMetricFamily("servoscope_source_up", "Whether a source is connected", labels=["source"])
        for name, source in self._service.sources.items():
            up.add_metric([name], float(source.up))
        yield from (last, verdict, standing, up, *self._own(GaugeMetricFamily))

    def _own(self, family: type) -> Iterable[Metric]:
        service = self._service
        for name, words, value in (
            ("store_up", "Whether the last attempt to store succeeded", service.writer.unavailable_since is None),
            ("buffered_blocks", "Blocks that wait to be stored", service.writer.waiting),
            ("buffer_blocks", "How many may wait", service.config.service.buffer),
            ("last_turn_age_seconds", "Since the service last looked for blocks", time.monotonic() - service.beat),
        ):
            yield family(f"servoscope_{name}", words, value=float(value))
