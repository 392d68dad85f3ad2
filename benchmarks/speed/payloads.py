"""What a sample costs between a plant's message and its block, by form; beside blocks of our own as JSON.

    python benchmarks speed/payloads [--json]

Processor time of this process alone, with everything in it from the bytes of a message to the block, at 100 Hz.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from tables import Table, parser, show

from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.mapping.sparkplug import payload_class
from servoscope.service.mqtt.payload import decode_block, encode_json
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import InboxMessage, RejectionCounter, SourceAsset, Transport

SAMPLES, RATE, ROUNDS = 10_000, 100.0, 3
FORMS: dict[str, dict[str, Any]] = {
    "columns": {"topics": ["a/{asset}"], "time": {"t": "s"}},
    "batches": {"topics": ["a/{asset}"], "time": {"t": "s"}},
    "rows": {"topics": ["a/{asset}"], "time": {"t": "s"}},
    "single": {"topics": ["a/{asset}/{signal}"], "time": {"t": "s"}, "value": "v"},
    "lines": {"form": "influx", "topics": ["a/{line}"]},
    "sparkplug": {"form": "sparkplug"},
}
WORDS = {
    "columns": "100 samples as columns, JSON",
    "batches": "100 rows in a message, JSON",
    "rows": "a row in a message, JSON",
    "single": "a value in a message, JSON",
    "lines": "20 lines of the line protocol",
    "sparkplug": "a row in a message, Sparkplug B with aliases",
    "blocks": "a block of our own, 100 samples, JSON",
}


class Given(Transport):
    """Has received some messages, topics and contents, already."""

    def __init__(self, messages: list[tuple[str, bytes]]) -> None:
        super().__init__()
        self.waiting.extend(InboxMessage(topic, content, 0.0) for topic, content in messages)

    def open(self, resume: Mapping[str, ResumePosition]) -> None:
        """Receive nothing more."""

    def close(self) -> None:
        """Stop."""


def write(form: str, rows: np.ndarray) -> list[tuple[str, bytes]]:
    """Return the messages of rows t, r, u, y, shape (4, N)."""
    parts = [rows[:, k : k + 100] for k in range(0, rows.shape[1], 100)]
    tables = [dict(zip("truy", one, strict=True)) for one in rows.T.tolist()]
    if form == "columns":
        plain = [{"t": one[0, 0], **dict(zip("ruy", one[1:].tolist(), strict=True))} for one in parts]
        return [("a/press", json.dumps(one).encode()) for one in plain]
    if form == "batches":
        return [("a/press", json.dumps(tables[k : k + 100]).encode()) for k in range(0, len(tables), 100)]
    if form == "rows":
        return [("a/press", json.dumps(one).encode()) for one in tables]
    if form == "single":
        return [
            (f"a/press/{name}", json.dumps({"t": one["t"], "v": one[name]}).encode())
            for one in tables
            for name in "ruy"
        ]
    if form == "lines":
        lines = [f"x,asset=press r={o['r']!r},u={o['u']!r},y={o['y']!r} {round(1e9 * o['t'])}" for o in tables]
        return [("a/line", "\n".join(lines[k : k + 20]).encode()) for k in range(0, len(lines), 20)]
    found = []
    for k, one in enumerate(tables):
        message = payload_class()(timestamp=round(1e3 * one["t"]))
        for alias, name in enumerate("ruy"):
            more = {"name": name, "datatype": 10} if k == 0 else {}
            message.metrics.add(alias=alias, double_value=one[name], **more)
        found.append((f"spBv1.0/g/{'DDATA' if k else 'DBIRTH'}/n/press", message.SerializeToString()))
    return found


def measure(run: Callable[[], int]) -> float:
    """Return the least processor time of a sample [us]."""
    times = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        samples = run()
        times.append(1e6 * (time.process_time() - begin) / samples)
    return min(times)


def main() -> None:
    """Measure all forms."""
    given = parser(__doc__).parse_args()
    start = time.time() - SAMPLES / RATE - 10.0
    rows = np.vstack([start + np.arange(SAMPLES) / RATE, np.random.default_rng(3).normal(size=(3, SAMPLES))])
    found = {}
    for form, keys in FORMS.items():
        messages, settings = write(form, rows), PayloadSettings.model_validate(keys)

        def run(messages: list[tuple[str, bytes]] = messages, settings: PayloadSettings = settings) -> int:
            asset = SourceAsset(SimpleNamespace(sample_rate=RATE), None, 60.0)  # type: ignore[arg-type]
            rejections, transport = RejectionCounter(), Given(messages)
            decoder = MessageMapping.of_assets(settings, {"press": asset}, rejections)
            inbox, blocks = Inbox(transport, decoder, {"press": asset}, rejections), []
            inbox.open({})
            while len(transport.waiting) or inbox.next_block_s == 0.0:
                blocks += inbox.poll(10**6)
            inbox.acknowledge("press", len(blocks))
            samples = sum(block.t.size for block in blocks)
            assert samples > 0.9 * SAMPLES
            return samples

        found[form] = measure(run)
    blocks = [encode_json(Block("press", k, *rows[:, 100 * k : 100 * k + 100])) for k in range(SAMPLES // 100)]
    found["blocks"] = measure(lambda: sum(decode_block("press", one).t.size for one in blocks))
    table = Table(
        "Plant messages",
        "Processor time from a message's bytes to the block.",
        ("message", "us per sample"),
        tuple((WORDS[form], f"{us:.1f}") for form, us in found.items()),
    )
    show([table], given.json, {form: f"{us:.0f}" for form, us in found.items()})
