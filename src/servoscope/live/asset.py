"""One asset followed live: blocks in, rows for the store out; all it remembers is its progress and its window."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from servoscope import quality
from servoscope.alarms import AlarmSettings, Command, Snapshot, Transition, advance, start, step
from servoscope.baseline import Baseline
from servoscope.complaints import instead
from servoscope.errors import AlarmError, StateError
from servoscope.live.arrival import arrive
from servoscope.live.block import Block
from servoscope.live.checkpoint import Counted, Progress
from servoscope.live.config import DiagnosisSettings
from servoscope.live.examining import Examined, Told, begun_at, examine
from servoscope.live.judging import Judged, Window, ask_in_full, judge, phase_of
from servoscope.live.numbering import Place, place
from servoscope.live.rows import Outcome, Row, transition_row
from servoscope.live.showing import about, shown, status_of, summary_of
from servoscope.live.thinning import thin
from servoscope.monitor import Monitor

__all__ = ["Asset", "Following"]


@dataclass(frozen=True)
class Following:
    """How assets are followed: the sections of the service file that each of them needs."""

    diagnosis: DiagnosisSettings
    quality: quality.QualitySettings
    alarms: AlarmSettings
    residual_every_s: float


class Asset:
    """Follows one asset.

    Parameters
    ----------
    name
        Its name.
    baseline
        What healthy looks like, at one operating point.
    monitor
        Of this baseline; assets that have it in common share it.
    how
        Settings.
    group
        What it belongs to, for people.
    """

    def __init__(self, name: str, baseline: Baseline, monitor: Monitor, how: Following, group: str = "") -> None:
        self.name, self.baseline, self.how = name, baseline, how
        self._about = about(baseline, group, how.diagnosis.window_s)
        self._monitor, self._rate = monitor, baseline.loop.sample_rate
        self._limits = how.quality.limits(self._rate)
        self._definitions = how.alarms.of_asset
        self._window: deque[Block] = deque()
        self._out = Outcome([], [])
        self.progress: Progress | None = None

    def warm(self) -> None:
        """Make the machine code that blocks need, so that the first one does not wait for it."""
        nothing = np.full(2, np.nan)
        self._monitor.run(self._monitor.init(), nothing, nothing, nothing)
        quality.examine(self._limits, quality.init(), np.arange(2.0), nothing, nothing, nothing)

    def resume(self, progress: Progress, window: Iterable[Block]) -> None:
        """Go on from a checkpoint.

        Raises
        ------
        StateError
            If the baseline is another one by now.
        """
        if progress.baseline != self.baseline.hash or progress.monitor.shape != self._monitor.init().shape:
            raise StateError(
                f"{self.name}: its saved state belongs to another baseline ({progress.baseline}, now "
                f"{self.baseline.hash}): run --anew {self.name} begins with a new state, behind the samples counted"
            )
        known = {
            name: progress.alarms.get(name) or start(self.name, name, progress.counted.t) for name in self._definitions
        }
        heard = quality.listen(progress.quality, progress.counted.t)
        self.progress, self._window = replace(progress, alarms=known, quality=heard), deque(window)

    def begin(self, counted: Counted) -> None:
        """Begin with a new state, before the first sample or behind those that were counted."""
        self.progress = Progress(
            asset=self.name,
            baseline=self.baseline.hash,
            counted=counted,
            monitor=self._monitor.init(),
            quality=quality.init(),
            judged=Judged(due=counted.t + self.how.diagnosis.window_s * (1.0 + phase_of(self.name)), since=counted.t),
            alarms={name: start(self.name, name, counted.t) for name in self._definitions},
        )

    def status(self, progress: Progress) -> dict[str, Any]:
        """Return what people are shown of a progress, as plain values."""
        return {**status_of(progress, self._definitions), "about": self._about}

    @property
    def keep(self) -> int:
        """The first number of the window: samples before it are no longer needed."""
        return self._window[0].sequence if self._window else self._now.counted.blocks

    def take(self, block: Block) -> Outcome:
        """Process a block; one that was counted before leads to nothing.

        Raises
        ------
        RecordingError
            If it is no block: empty, without time, or of signals of different lengths.
        """
        began = block.begins()
        found = place(self.progress.counted if self.progress is not None else None, block)
        if self.progress is None:
            self.begin(Counted(began, began, stream=block.stream))
        counted, self._out = self._now.counted, Outcome([], [])
        if found is None:
            self.progress = replace(self._now, counted=replace(counted, repeated=counted.repeated + 1))
            return self._out
        # kept under a number of our own, for the sender's may begin anew
        self._window.append(replace(block, sequence=counted.blocks))
        self._out.rows.append(Row("recent", {"sequence": counted.blocks, "samples": block.pack()}))
        if found.lost or found.anew:
            what = "blocks lost" if found.lost else "stream began anew"
            words = {"after": [counted.stream, counted.sequence], "before": [block.stream, block.sequence]}
            document = {"blocks": found.lost, **words}
            self._out.rows.append(Row("audit", {"who": "servoscope", "what": what, "document": document}))
        self._follow(block, found)
        self._judge()
        self._raise_alarms()
        self._forget()
        return self._out

    def tick(self, elapsed_s: float) -> Outcome:
        """Let time pass without a block: so long after the last one, by the asset's clock, silence is an alarm."""
        self._out = Outcome([], [])
        if self.progress is None:
            return self._out
        progress, now = self.progress, self.progress.counted.t + elapsed_s
        watched, findings = quality.tick(self._limits, progress.quality, now)
        self.progress = replace(progress, quality=watched)
        if findings or "silent" in quality.standing(watched):
            self._raise_alarms(now)
        return self._out

    def obey(self, alarm: str, command: Command) -> Outcome:
        """Carry out an operator's command.

        Raises
        ------
        AlarmError
            If there is no such alarm, or the command has no meaning in its state.
        """
        if self.progress is None or alarm not in self._definitions:
            raise AlarmError(f"{self.name}: has no alarm {alarm!r}, {instead(alarm, self._definitions)}")
        progress, self._out = self.progress, Outcome([], [])
        state = progress.alarms[alarm]
        state, transitions = step(self._definitions[alarm], state, command, max(state.at, progress.counted.t))
        self.progress = replace(progress, alarms={**progress.alarms, alarm: state})
        self._tell(transitions)
        return self._out

    def wanted(self, *, ended: bool = False) -> list[tuple[Window, list[Block]]]:
        """Return the full diagnoses whose windows are complete, or end here, with their samples."""
        if self.progress is None:
            return []
        t, after = self.progress.counted.t, self.how.diagnosis.after_s
        # complete, or never to be: the clock was set back
        ready = [one for one in self.progress.windows if ended or not one.until - after <= t < one.until]
        return [(one, [b for b in self._window if b.sequence >= one.first and b.t[0] < one.until]) for one in ready]

    def is_news(self, window: Window, said: Told) -> bool:
        """Return whether a full diagnosis is the first of its fault, or names others than the last one."""
        found = names_of(said.document.get("faults", []))
        return self._is_first(window) or bool(found and found != names_of(self._now.judged.faults))

    def _is_first(self, window: Window) -> bool:
        """Return whether no window of its fault came before."""
        return window.until <= self._now.judged.since + self.how.diagnosis.after_s

    def told(self, window: Window, said: Told) -> Outcome:
        """Take the answer to one of `wanted`, once."""
        progress = self._now
        if window not in progress.windows:
            return Outcome([], [])
        judged = progress.judged
        if judged.verdict != "fault" or window.until > judged.since:  # else of a fault before this one
            # a later window that names nothing, for the fault changes in it, says no less
            faults = said.document.get("faults") or judged.faults
            if not self._is_first(window):
                said = begun_at(said, judged.onset)
            named = said.summary if said.document.get("faults") or not judged.named else judged.named
            judged = replace(judged, named=named)
            if judged.verdict == "fault":
                first = self._is_first(window) and said.onset is not None
                judged = replace(judged, faults=faults, onset=said.onset if first else judged.onset)
        left = tuple(one for one in progress.windows if one != window)
        self.progress = replace(progress, judged=judged, windows=left)
        values = {"number": window.number, "t": window.until, "grounds": window.why, **said._asdict()}
        self._forget()
        return Outcome([Row("diagnoses", values)], [])

    @property
    def _now(self) -> Progress:
        assert self.progress is not None, "begin or resume comes first"
        return self.progress

    def _number(self) -> int:
        """Return the number of a new row."""
        progress = self._now
        number = progress.counted.rows + 1
        self.progress = replace(progress, counted=replace(progress.counted, rows=number))
        return number

    def _add(self, table: str, **values: Any) -> None:
        self._out.rows.append(Row(table, {"number": self._number(), **values}))

    def _follow(self, block: Block, found: Place) -> None:
        """Let monitor and data quality see the samples."""
        progress = self._now
        arrival = arrive(block.t, np.nan if progress.last is None else progress.last, 1.0 / self._rate)
        restart = arrival.restart[arrival.used]
        restart[:1] |= found.lost > 0 or found.anew
        signals = np.stack([block.r, block.u, block.y])[:, arrival.used]
        r, u, y = np.where(np.isfinite(signals), signals, np.nan)
        monitor, trace = self._monitor.run(progress.monitor, r, u, y, restart)
        watched, _ = quality.examine(self._limits, progress.quality, block.t, block.r, block.u, block.y)
        watched, _ = quality.tick(self._limits, watched, arrival.t if np.isfinite(arrival.t) else progress.counted.t)
        at = np.rint(trace.t * self._rate).astype(np.int64) - progress.fed
        thinned, rows = thin(progress.thinned, trace, block.t[arrival.used][at], self.how.residual_every_s)
        counted = progress.counted
        self.progress = replace(
            progress,
            monitor=monitor,
            quality=watched,
            thinned=thinned,
            shown=shown(trace, float(block.t[arrival.used][at[-1]])) if at.size else progress.shown,
            last=arrival.t if np.isfinite(arrival.t) else None,
            fed=progress.fed + r.size,
            counted=replace(
                counted,
                t=arrival.t if np.isfinite(arrival.t) else counted.t,
                sequence=block.sequence,
                stream=block.stream,
                blocks=counted.blocks + 1,
                samples=counted.samples + block.t.size,
                lost=counted.lost + found.lost,
                digest=block.digest(counted.digest),
            ),
        )
        for row in rows:
            self._add("residuals", **row)

    def _judge(self) -> None:
        """Examine the last minutes if it is time to, and ask for a full diagnosis where that is news."""
        progress, settings = self._now, self.how.diagnosis
        t, before = progress.counted.t, progress.judged.verdict
        exceeded = bool(progress.shown.get("exceeded", False))

        def look() -> Examined:
            return examine(self.baseline, self.name, self._last(settings.window_s))

        judged, found = judge(progress.judged, settings, t, exceeded, look, phase_of(self.name))
        self.progress = replace(progress, judged=judged)
        if found is None:
            return
        if found.verdict != before:
            told = Told(found.verdict, found.summary, found.onset, found.document or {})
            self._add("diagnoses", t=t, grounds="examination", **told._asdict())
        judged, in_full = ask_in_full(judged, settings.window_s, t)
        if in_full:
            window = Window(self._number(), self._last(settings.window_s)[0].sequence, t + settings.after_s, "full")
            self.progress = replace(self._now, judged=judged, windows=(*self._now.windows, window))

    def _last(self, seconds: float) -> list[Block]:
        """Return the blocks of the last seconds."""
        return [block for block in self._window if block.t[-1] > self._now.counted.t - seconds]

    def _raise_alarms(self, t: float | None = None) -> None:
        """Tell the alarms what is known now."""
        progress = self._now
        judged, findings = progress.judged, tuple(quality.standing(progress.quality))
        peaks = progress.shown.get("peaks", (None, None))
        seen = Snapshot(
            verdict=quality.judged(judged.verdict, findings),
            quality=findings,
            statistic=peaks[0],
            level=peaks[1],
            cause=summary_of(judged, findings),
        )
        alarms, transitions = advance(self._definitions, progress.alarms, seen, progress.counted.t if t is None else t)
        self.progress = replace(progress, alarms=alarms)
        self._tell(transitions)

    def _tell(self, transitions: Sequence[Transition]) -> None:
        self._out.transitions.extend(transitions)
        for one in transitions:
            self._add("transitions", **transition_row(one, self._definitions[one.alarm]))

    def _forget(self) -> None:
        """Let go of samples that no examination needs any more; of a clock that was set back as well."""
        progress, window_s = self._now, self.how.diagnosis.window_s
        first = min((window.first for window in progress.windows), default=None)
        held = sum(block.t.size for block in self._window)
        while self._window and (first is None or self._window[0].sequence < first):
            old = self._window[0].t[-1] <= progress.counted.t - window_s
            if not old and held <= 2.0 * window_s * self._rate:
                return
            held -= self._window.popleft().t.size


def names_of(faults: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return which faults are named."""
    return {str(one["name"]) for one in faults}
