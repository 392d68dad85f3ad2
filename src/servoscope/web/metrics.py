"""The server's metrics for Prometheus: answers, readers of events, and the assets as the store has them."""

from __future__ import annotations

from collections import Counter as TotalCounter
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from starlette.types import Scope

from servoscope.service.health import alarm_gauge
from servoscope.web.event_hub import EventHub
from servoscope.web.statuses import asset_statuses

BUCKETS_S = tuple(base * 10.0**power for power in (-3, -2, -1, 0, 1) for base in (1.0, 2.0, 5.0))
CUT_REASONS = ("handshake", "header", "body", "answer", "room", "refused")
METHODS = ("GET", "HEAD", "POST", "DELETE", "OPTIONS", "PUT", "PATCH")


class WebMetrics:
    """The metrics of one server, whose hub knows the assets; `cut` counts connections that were closed, by reason."""

    def __init__(self, hub: EventHub, cut: Mapping[str, int]) -> None:
        self._hub, self._cut = hub, cut
        self._registry = registry = CollectorRegistry()
        labels = ["method", "route", "status"]
        self._requests = Counter("servoscope_http_requests", "Requests that were answered", labels, registry=registry)
        self._seconds = Histogram(
            "servoscope_http_request_seconds", "Time to an answer", ["route"], buckets=BUCKETS_S, registry=registry
        )
        self.event_readers = Gauge("servoscope_http_live_readers", "Pages that are told what is new", registry=registry)
        registry.register(self)  # whatever has a method collect

    def observe(self, scope: Scope, status: int, seconds: float) -> None:
        """Count an answer, under its route: addresses would be without number."""
        route = getattr(scope.get("route"), "path", None) or "other"
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._requests.labels(method, route, str(status)).inc()
        if not route.endswith("/live"):  # which is answered for as long as a page is open
            self._seconds.labels(route).observe(seconds)

    def render(self) -> bytes:
        """Return all of them as Prometheus reads them."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Yield what is read from elsewhere."""
        text = "Connections that were closed because the client was slow, or because there was no room"
        cut = CounterMetricFamily("servoscope_http_connections_cut", text, labels=["why"])
        for why in CUT_REASONS:
            cut.add_metric([why], self._cut.get(why, 0))
        yield cut
        up = float(not self._hub.error)
        yield GaugeMetricFamily("servoscope_store_up", "Whether the store answered at the last look", value=up)
        verdicts = GaugeMetricFamily("servoscope_verdict", "1 for the verdict that holds", labels=["asset", "verdict"])
        times = GaugeMetricFamily("servoscope_stored_time_seconds", "When an asset was last stored", labels=["asset"])
        count: TotalCounter[tuple[str, str, str]] = TotalCounter()
        for stored, status in asset_statuses(list(self._hub.statuses.values())):
            verdicts.add_metric([stored.name, status.verdict], 1.0)
            times.add_metric([stored.name], stored.at)
            count.update((name, alarm.priority or "", alarm.state.value) for name, alarm in status.alarms.items())
        yield from (verdicts, alarm_gauge(count), times)
