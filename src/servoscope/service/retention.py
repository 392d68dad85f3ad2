"""What a store keeps, and for how long: what is older is deleted, so that the disk does not fill up."""

from __future__ import annotations

import math
from collections.abc import Mapping

from servoscope.service.config import StoreSettings
from servoscope.service.store import Store

DAY_S = 86400.0


def delete_old_rows(
    store: Store, settings: StoreSettings, service: str, clocks: Mapping[str, float], now: float
) -> dict[str, int]:
    """Delete what is older than the settings say; return how many rows of which table.

    `clocks`: by each asset that `service` follows, its own time [UTC s]; `now`: that of this machine [UTC s].
    """
    written, counts = store.checkpoint_times(), {}
    for table, days in (
        ("residuals", settings.residual_days),
        ("sizes", settings.size_days),
        ("diagnoses", settings.event_days),
        ("transitions", settings.event_days),
    ):
        if days is None:
            continue
        before = {name: t - days * DAY_S for name, t in clocks.items()}
        # of an asset that nobody follows any more, all rows are older than its last checkpoint
        before |= {name: math.inf for name, at in written.items() if name not in clocks and at < now - days * DAY_S}
        if table == "transitions":
            before[service] = now - days * DAY_S
        counts[table] = store.delete_before(table, before)
    if settings.event_days is not None:
        counts |= store.delete_events(service, list(clocks), now - settings.event_days * DAY_S)
    return {table: count for table, count in counts.items() if count}
