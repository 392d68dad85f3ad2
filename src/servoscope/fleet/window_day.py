"""A day of a machine that nothing follows, diagnosed window by window: up to the first fault, or to its end."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.core.messages import Message
from servoscope.diagnosis.result import Diagnosis
from servoscope.fleet.read import read_blocks
from servoscope.fleet.rows import MICRO, Rows
from servoscope.machines.protocol import Machine
from servoscope.signals.readers.logged_rows import MIN_EPOCH_S

MIN_REST = 0.5  # of a window: a shorter rest of a day is no window of its own


def examine_windows(machine: Machine, files: Sequence[str], window_s: float) -> dict[str, Any]:
    """Return the result of a day as `day_result` does, without the evidence for causes that assets have in common.

    Raises RecordingError if a window cannot be used.
    """
    result: dict[str, Any] = {}
    names = machine.channels
    first_us, samples, windows, peak = None, 0, 0, 0.0
    for rows in cut_windows(read_blocks(files, machine.carrier.columns), round(window_s * MICRO)):
        first_us = int(rows.t_us[0]) if first_us is None else first_us
        if lacking := [name for name in names if name not in rows.channels]:
            raise RecordingError(f"window: has no {', '.join(lacking)}, name columns as the loop file does")
        signals = (rows.r, rows.u, rows.y, *(rows.channels[name] for name in names))
        window = machine.judge_window("window", np.stack([(rows.t_us - first_us) / MICRO, *signals]))
        samples, windows, peak = samples + len(rows), windows + 1, max(peak, window.evidence or 0.0)
        diagnosis, is_fault = window.diagnosis, window.diagnosis.verdict == "fault"
        if result and diagnosis.verdict == "undetermined":
            continue  # a machine that rests takes nothing back
        diagnosis = _on_clock_of_day(diagnosis, window.start, first_us / MICRO)
        document = json.loads(diagnosis.model_dump_json(exclude={"recording"}))
        result = {"diagnosis": document, "last_us": int(rows.t_us[-1])}
        result["alarm_us"] = result["last_us"] if is_fault else None
        if is_fault:
            break
    if first_us is None:
        raise NotEnoughError("holds no rows")
    counts = {"samples": samples, "repeats": 0, "missing": 0, "gaps": 0, "evaluations": windows, "peak": peak}
    return {"status": "examined", "error": None, "baseline": machine.hash, "first_us": first_us, **counts, **result}


def _on_clock_of_day(diagnosis: Diagnosis, start: float, first: float) -> Diagnosis:
    """Return a diagnosis whose time is 0 at `start` [s] of a day that began at `first` [s], on the clock of the day."""
    onset, since = diagnosis.onset_s, diagnosis.headline.values.get("since")
    if onset is None or not isinstance(since, Message):
        return diagnosis
    headline = diagnosis.headline
    if first >= MIN_EPOCH_S:
        headline = diagnosis.dated_headline(first + start)
    elif "t" in since.values:
        since = since.model_copy(update={"values": {**since.values, "t": start + since.values["t"]}})
        headline = headline.model_copy(update={"values": {**headline.values, "since": since}})
    interval = diagnosis.current.model_copy(update={"onset_s": tuple(start + t for t in onset)})
    return diagnosis.model_copy(update={"headline": headline, "intervals": (interval,)})


def cut_windows(blocks: Iterable[Rows], length_us: int) -> Iterator[Rows]:
    """Yield the rows of blocks in the order of time as windows of this length [us], and a rest that is long enough."""
    waiting, windows = Rows.empty(), 0
    for rows in blocks:
        waiting = Rows.concatenate([waiting, rows])
        while len(waiting) and waiting.t_us[-1] - waiting.t_us[0] >= length_us:
            inside = waiting.t_us < waiting.t_us[0] + length_us
            yield waiting[inside]
            waiting, windows = waiting[~inside], windows + 1
    if len(waiting) and (not windows or waiting.t_us[-1] - waiting.t_us[0] >= MIN_REST * length_us):
        yield waiting
