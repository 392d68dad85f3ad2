"""What sources send before anything is followed: each asset of a service file, how it is heard, and what it lacks."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from typing import NamedTuple

import numpy as np

from servoscope.core.messages import message, render
from servoscope.service.assets.reception import Reception, ReceptionLog
from servoscope.service.build import build_visit
from servoscope.service.config import ServiceFile
from servoscope.service.sources.block import Block

POLL_S = 0.05
MIN_BLOCKS_FOR_RATE = 3  # of an asset: they tell its rate
RATE_ERROR = 0.05  # relative: from there on a rate is another one


class CommissioningRow(NamedTuple):
    """An asset as it was heard."""

    asset: str
    source: str
    reception: Reception
    blocks: int
    rate_hz: float  # samples per second by their time stamps; NaN: nothing came
    needed_hz: float  # that of its loop
    age_s: float  # newest time stamp, seen from this machine's clock; negative: ahead of it; NaN: nothing came


def listen(config: ServiceFile, seconds: float) -> list[CommissioningRow]:
    """Connect to all sources as a visitor who takes nothing away, and return each asset as it is heard.

    Ends early when all assets have been heard. Raises ServoscopeError if something the file names cannot be used.
    """
    assets, sources = build_visit(config)
    logs = {name: ReceptionLog(heard_before=False) for name in assets}
    blocks: dict[str, list[Block]] = defaultdict(list)
    strange: dict[str, str] = {}  # by source, why the last message that is of no asset was refused
    start = time.monotonic()
    for source in sources.values():
        source.open({})
    try:
        while (now := time.monotonic() - start) < seconds:
            for name, source in sources.items():
                for block in source.poll(1000):
                    blocks[block.asset].append(block)
                    logs[block.asset].hear(now)
                for rejection in source.rejections.take():
                    if rejection.asset:
                        logs[rejection.asset].refuse(now, rejection.reason)
                    else:
                        strange[name] = rejection.reason
            if all(len(blocks[name]) >= MIN_BLOCKS_FOR_RATE for name in assets):
                break
            time.sleep(POLL_S)
        rows = []
        for name, asset in assets.items():
            source_name, needed = config.assets[name].source, asset.machine.rate
            source = sources[source_name]
            reception = logs[name].evaluate(now, 2.0 * seconds, source.trouble, source.asset_troubles.get(name))
            if reception.state == "unheard" and source_name in strange and not reception.source_down:
                words = message("service.reception.strange", why=reception.why, reason=strange[source_name])
                reception = Reception("unheard", render(words))
            rate, age = _measure(blocks[name])
            if reception.state == "followed" and source.clock_rate == 1.0:
                reception = _judge(reception, rate, needed, age, config.service.ahead_s)
            rows.append(CommissioningRow(name, source_name, reception, len(blocks[name]), rate, needed, age))
        return rows
    finally:
        for source in sources.values():
            source.close()


def _measure(blocks: list[Block]) -> tuple[float, float]:
    """Return the samples per second of blocks, and the age of the newest one [s]."""
    steps = np.concatenate([np.diff(block.t) for block in blocks]) if blocks else np.zeros(0)
    steps = steps[steps > 0.0]
    rate = 1.0 / float(np.median(steps)) if steps.size else math.nan
    newest = max((float(np.nanmax(block.t)) for block in blocks), default=math.nan)
    return rate, time.time() - newest


def _judge(reception: Reception, rate: float, needed: float, age: float, ahead_s: float) -> Reception:
    if age < -ahead_s:
        return Reception("refused", render(message("service.reception.future", ahead_s=round(-age - ahead_s, 1))))
    if abs(rate - needed) > RATE_ERROR * needed:
        return Reception("slow", render(message("service.reception.rate", rate=rate, needed=needed)))
    return reception
