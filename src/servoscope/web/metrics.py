"""What Prometheus is told of the server: its answers, its readers, and the assets as the store has them."""

from __future__ import annotations

from collections import Counter as Tally
from collections.abc import Iterator
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from starlette.types import Scope

from servoscope.web.hub import of_assets

if TYPE_CHECKING:
    from servoscope.web.hub import Hub

__all__ = ["Metrics"]

SECONDS = tuple(base * 10.0**power for power in (-3, -2, -1, 0, 1) for base in (1.0, 2.0, 5.0))
METHODS = ("GET", "HEAD", "POST", "DELETE", "OPTIONS", "PUT", "PATCH")


class Metrics:
    """The metrics of one server.

    Parameters
    ----------
    hub
        Knows the assets.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._registry = registry = CollectorRegistry()
        labels = ["method", "route", "status"]
        self._answers = Counter("servoscope_http_requests", "Requests that were answered", labels, registry=registry)
        self._seconds = Histogram(
            "servoscope_http_request_seconds", "Time to an answer", ["route"], buckets=SECONDS, registry=registry
        )
        self.readers = Gauge("servoscope_http_live_readers", "Pages that are told what is new", registry=registry)
        registry.register(self)  # whatever has a method collect

    def answered(self, scope: Scope, status: int, seconds: float) -> None:
        """Take note of an answer, under its route: addresses would be without number."""
        route = getattr(scope.get("route"), "path", None) or "other"
        method = scope["method"] if scope["method"] in METHODS else "other"
        self._answers.labels(method, route, str(status)).inc()
        if not route.endswith("/live"):  # which is answered for as long as a page is open
            self._seconds.labels(route).observe(seconds)

    def text(self) -> bytes:
        """Return all of them as Prometheus reads them."""
        return generate_latest(self._registry)

    def collect(self) -> Iterator[Metric]:
        """Yield what is read from the hub."""
        up = float(not self._hub.unavailable)
        yield GaugeMetricFamily("servoscope_store_up", "Whether the store answered at the last look", value=up)
        verdict = GaugeMetricFamily("servoscope_verdict", "1 for the verdict that holds", labels=["asset", "verdict"])
        stored = GaugeMetricFamily("servoscope_stored_time_seconds", "When an asset was last stored", labels=["asset"])
        alarms: Tally[tuple[str, str, str]] = Tally()
        for name, row in of_assets(dict(self._hub.rows)).items():
            verdict.add_metric([name, row["status"]["verdict"]], 1.0)
            stored.add_metric([name], row["at"])
            for alarm, one in row["status"]["alarms"].items():
                alarms[alarm, one["priority"], one["state"]] += 1
        standing = GaugeMetricFamily(
            "servoscope_alarms", "Alarms that are not normal", labels=["alarm", "priority", "state"]
        )
        for labels, count in alarms.items():
            standing.add_metric(list(labels), count)
        yield from (verdict, stored, standing)
