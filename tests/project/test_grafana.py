"""The Grafana dashboard asks for metrics that exist, and its SQL runs on a real store."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import sqlalchemy as sa
from reliability.servers import Postgres

from servoscope.service.clock import LayerTimes
from servoscope.service.metrics import ServiceMetrics
from servoscope.service.store import Batch, Store

GRAFANA = Path(__file__).resolve().parents[2] / "grafana"
DASHBOARD = json.loads((GRAFANA / "dashboards" / "servoscope.json").read_text(encoding="utf-8"))
LABELS = {"layer", "asset", "verdict", "alarm", "priority", "state", "source", "kind", "le"}
NOW = 1767225600.0


def targets() -> Iterator[dict[str, Any]]:
    for panel in DASHBOARD["panels"]:
        yield from panel["targets"]


def queries() -> list[str]:
    found = [target["rawSql"] for target in targets() if "rawSql" in target]
    found += [one["query"] for one in DASHBOARD["templating"]["list"]]
    return found + [one["rawQuery"] for one in DASHBOARD["annotations"]["list"]]


def test_every_metric_is_there_and_every_metric_is_shown() -> None:
    writer = SimpleNamespace(unavailable_since=None, waiting=0, capacity=1)
    clock = {"last_turn": time.monotonic()}
    service: Any = SimpleNamespace(
        assets={}, sources={}, troubles={"connection": {}}, writer=writer, layers=LayerTimes(), **clock
    )
    text = ServiceMetrics(service).render().decode()
    known = {name for name in re.findall(r"^# TYPE (\w+) ", text, re.MULTILINE) if not name.endswith("_created")}
    asked = "\n".join(target["expr"] for target in targets() if "expr" in target)
    used = {re.sub(r"_bucket$", "", name) for name in re.findall(r"servoscope_\w+", asked)}
    assert used == known
    labels = {label for part in re.findall(r"by \(([^)]*)\)", asked) for label in re.split(r",\s*", part)}
    assert labels <= LABELS


def test_every_query_runs_and_finds_what_is_there(postgres: Postgres) -> None:
    status = {"verdict": "fault", "summary": "Fault.", "since": NOW, "ne107": "failure", "statistic": 3.0, "level": 2.0}
    document = {"event": "occur", "priority": "high"}
    batch = Batch()
    batch.checkpoints["press"] = {
        "asset": "press", "sequence": 3, "state": b"", "status": {**status, "counted": {"t": NOW}}, "at": NOW,
    }  # fmt: skip
    common = {"asset": "press", "number": 1, "t": NOW}
    batch.rows["residuals"].append({**common, "statistic": 3.0, "level": 2.0, "residual": [[1.0, 3.0, 4.0, 10.0]]})
    batch.rows["diagnoses"].append(
        {**common, "grounds": "full", "verdict": "fault", "summary": "", "onset": NOW, "document": {}}
    )
    states = {"alarm": "fault", "before": "normal", "after": "unacknowledged", "cause": "", "who": "system"}
    batch.rows["transitions"].append({**common, **states, "document": document})
    # of an asset that is not chosen; what is of no asset at all is the service's own, and always shown
    batch.rows["transitions"].append({**common, **states, "asset": "crane", "after": "normal", "document": document})
    batch.first_needed["crane"] = 0
    batch.rows["audit"].append({"at": NOW, "who": "ann", "asset": "press", "what": "started", "document": {}})
    batch.rows["outbox"].append(
        {"key": "a", "sink": "desk", "event": {}, "created": NOW, "due": NOW, "attempts": 1, "outcome": ""}
    )
    store = Store.open(postgres.url, write=True)
    store.write(batch, "hall", 1)
    store.close()
    engine = sa.create_engine(postgres.url.replace("postgresql", "postgresql+psycopg"))
    with engine.connect() as connection:
        for query in queries():
            plain = re.sub(r"\$__unixEpochFilter\((\w+)\)", rf"\1 >= {NOW - 1.0} AND \1 <= {NOW + 1.0}", query)
            plain = plain.replace("$asset", "'press', 'lift'")
            assert "$" not in plain
            found = connection.exec_driver_sql(plain.replace("%", "%%")).mappings().all()
            assert len(found) == 1, query
            if "'residual" in query or "json_array_elements" in query:
                assert found[0]["value"] == 0.5 and found[0]["metric"] == "press 1.0 Hz"
    engine.dispose()


def test_data_sources_are_those_that_are_provisioned() -> None:
    provisioned = (GRAFANA / "provisioning" / "datasources" / "servoscope.yaml").read_text(encoding="utf-8")
    for one in [*targets(), *DASHBOARD["panels"], *DASHBOARD["templating"]["list"], *DASHBOARD["annotations"]["list"]]:
        assert f"uid: {one['datasource']['uid']}\n    type: {one['datasource']['type']}" in provisioned
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(ids) == len(set(ids))
