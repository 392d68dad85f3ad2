"""Metrics for Prometheus: read from the service when they are scraped, so that nothing is counted twice.

Those of each asset are written as text: the client takes ten times as long, and a service has thousands.
"""

from __future__ import annotations

import time
from collections import Counter as TotalCounter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ConfigError
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.status import asset_verdict
from servoscope.service.health import alarm_gauge
from servoscope.service.parts import ServiceParts
from servoscope.service.sources.message import Rejection
from servoscope.signals import quality

if TYPE_CHECKING:
    from prometheus_client.core import Metric


STREAM_COUNTERS = {
    "blocks": "Blocks that were counted",
    "samples": "Samples that were counted",
    "lost": "Blocks that never came",
    "repeated": "Blocks that came once more and were left out",
    "late": "Blocks left out because their time stamps lie behind what was counted",
    "future": "Blocks left out because their time stamps lie ahead of the service's clock",
}
BUCKETS_S = tuple(float(f"{base}e{power}") for power in (-3, -2, -1, 0, 1) for base in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))


class ServiceMetrics:
    """The metrics of one service; counts of assets are those of their checkpoints, and continue over restarts."""

    def __init__(self, service: ServiceParts) -> None:
        try:
            from prometheus_client import CollectorRegistry, Counter, Histogram
        except ModuleNotFoundError:
            raise ConfigError("prometheus-client is missing, pip install 'servoscope[service]'") from None
        self._service, self.registry = service, CollectorRegistry()

        def counter(name: str, text: str, labels: Sequence[str] = ()) -> Counter:
            return Counter(f"servoscope_{name}", text, labelnames=labels, registry=self.registry)

        self.failures = counter("store_failures", "Attempts to store that failed")
        # of blocks: how many in each bin, and their sum [s]; one by one they would take longer than a kernel
        self._latencies = np.zeros(len(BUCKETS_S) + 1, dtype=np.int64), 0.0
        words = "Duration of a commit"
        self._commits = Histogram("servoscope_commit_seconds", words, buckets=BUCKETS_S, registry=self.registry)
        self._alarms = TotalCounter[tuple[str, str, str]]()  # that are not normal, by name, priority and state
        self._render_s = 0.0  # processor time of `render` so far [s]
        self._rejections = counter("refused", "Messages that could not be used", ["source", "asset", "kind"])
        self.registry.register(self)  # calls `collect`

    def record_commit(self, latencies: FloatArray, seconds: float) -> None:
        """Count a commit of blocks with these latencies [s], shape (N,), which took so long [s]."""
        self._commits.observe(seconds)
        places = np.bincount(np.searchsorted(BUCKETS_S, latencies), minlength=len(BUCKETS_S) + 1)
        self._latencies = self._latencies[0] + places, self._latencies[1] + float(latencies.sum())

    def record_rejection(self, source: str, rejection: Rejection) -> None:
        """Count messages that could not be used."""
        self._rejections.labels(source, rejection.asset, rejection.kind).inc(rejection.count)

    def render(self) -> bytes:
        """Return all of them in the format of Prometheus."""
        from prometheus_client import generate_latest

        start = time.thread_time()
        series, self._alarms = write_asset_series(self._service.assets)
        text = generate_latest(self.registry) + series.encode()
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
        for name, why in service.troubles["connection"].items():
            trouble.add_metric([name], float(bool(why)))
        layers = CounterMetricFamily("servoscope_processor_seconds", "Processor time by layer", labels=["layer"])
        shares = TotalCounter({**service.layers.seconds, "metrics": self._render_s})
        for source in service.sources.values():
            shares.update(source.transport.layer_seconds)
        for layer, seconds in shares.items():
            layers.add_metric([layer], seconds)
        up = GaugeMetricFamily("servoscope_source_up", "Whether a source is connected", labels=["source"])
        files = GaugeMetricFamily("servoscope_files_waiting", "Files that wait to be read", labels=["source"])
        oldest = GaugeMetricFamily("servoscope_oldest_file_wait_seconds", "Since it was complete", labels=["source"])
        for name, source in service.sources.items():
            up.add_metric([name], float(source.connected))
            if (backlog := source.transport.backlog) is not None:
                files.add_metric([name], float(backlog.files))
                oldest.add_metric([name], backlog.oldest_s)
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
            files,
            oldest,
        )
        for name, words, value in (
            ("store_up", "Whether the last attempt to store succeeded", service.writer.unavailable_since is None),
            ("buffered_blocks", "Blocks that wait to be stored", service.writer.waiting),
            ("buffer_blocks", "How many may wait", service.writer.capacity),
            ("last_turn_age_seconds", "Since the service last looked for blocks", time.monotonic() - service.last_turn),
        ):
            yield GaugeMetricFamily(f"servoscope_{name}", words, value=float(value))


def write_asset_series(assets: Mapping[str, Asset]) -> tuple[str, TotalCounter[tuple[str, str, str]]]:
    """Return the metrics of assets as text, and how many alarms of each name, priority and state are not normal.

    From any thread; assets that have not begun have only a reception.
    """
    counts: dict[str, list[str]] = {key: [] for key in STREAM_COUNTERS}
    last, verdicts, receptions, alarms = list[str](), list[str](), list[str](), TotalCounter[tuple[str, str, str]]()
    for name, asset in assets.items():
        label, reception = f'asset="{escape_label(name)}"', asset.reception
        of_source = f'source="{escape_label(asset.source)}",state="{reception.state}"'
        receptions.append(f"servoscope_reception{{{label},{of_source}}} 1.0")
        if (visible := asset.visible_record) is None:
            continue
        state, position = visible
        for key, lines in counts.items():
            lines.append(f"servoscope_{key}_total{{{label}}} {float(getattr(position, key))}")
        if position.blocks:
            last.append(f"servoscope_last_sample_time_seconds{{{label}}} {position.t}")
        verdict = asset_verdict(state.examination, quality.active_findings(state.quality), reception)
        verdicts.append(f'servoscope_verdict{{{label},verdict="{verdict}"}} 1.0')
        alarms.update(asset.alarms.standing(state.alarms))
    families = [(f"{key}_total", "counter", STREAM_COUNTERS[key], lines) for key, lines in counts.items()]
    families += [
        ("last_sample_time_seconds", "gauge", "Time of the last sample", last),
        ("reception", "gauge", "1 for how an asset's samples come in", receptions),
        ("verdict", "gauge", "1 for the verdict that holds", verdicts),
    ]
    text = ""
    for name, kind, words, lines in families:
        heads = f"# HELP servoscope_{name} {words}", f"# TYPE servoscope_{name} {kind}"
        text += "\n".join([*heads, *lines, ""])
    return text, alarms


def escape_label(value: str) -> str:
    """Return a value of a label as Prometheus reads it."""
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
