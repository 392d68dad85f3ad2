"""A servo loop as a machine: what the packages of the method say of one, behind the protocol."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import chain, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import BaselineSource
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import Message
from servoscope.machines.protocol import Catch, LogDiagnosis, WindowDiagnosis
from servoscope.models.loop import Loop
from servoscope.signals import Recording

if TYPE_CHECKING:
    from servoscope.detection.trace import Trace
    from servoscope.diagnosis.monitor import Monitor

SIGNAL_POINTS, TRACE_POINTS = 2000, 1000


class LoopMachine:
    """A servo loop with its baseline."""

    def __init__(self, baseline: Baseline) -> None:
        self.baseline = baseline

    @classmethod
    def load(cls, path: str | Path) -> LoopMachine:
        """Read the file of a baseline; raises BaselineError if it cannot be used."""
        return cls(Baseline.load(path))

    @classmethod
    def parse(cls, text: str) -> LoopMachine:
        """Return what `to_json` has written."""
        return cls(Baseline.model_validate_json(text))

    @classmethod
    def learn(cls, loop: Path, logs: Sequence[Path], catch: Catch) -> LoopMachine:
        """Learn from healthy logs and a loop file; each log is read within a context of `catch`."""
        from servoscope.diagnosis.operating_points import learn
        from servoscope.signals import readers

        settings, recordings = Loop.load(loop), list[Recording]()
        for path in logs:
            with catch():
                recordings.append(readers.read(path, settings))
        if not recordings:
            raise NotEnoughError(f"{loop}: none of its logs can be used")
        return cls(learn(settings, recordings))

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind."""
        self.baseline.save(path)

    def to_json(self) -> str:
        """Return the baseline as text."""
        return json.dumps(self.baseline.model_dump(mode="json", by_alias=True))

    @property
    def kind(self) -> str:
        """The kind of its plant."""
        return self.baseline.loop.plant.kind

    @property
    def name(self) -> str:
        """Of the loop file."""
        return self.baseline.loop.name

    @property
    def hash(self) -> str:
        """A digest of the baseline."""
        return self.baseline.hash

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.baseline.loop.sample_rate

    @property
    def carrier(self) -> Loop:
        """The loop."""
        return self.baseline.loop

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the logged covariates."""
        return self.baseline.logged_covariates

    @property
    def needs_channels_alone(self) -> bool:
        """Whether r, u and y count for nothing."""
        return False

    @property
    def points(self) -> tuple[str, ...]:
        """Names of its operating points."""
        return self.baseline.points

    @property
    def point(self) -> str:
        """Its operating point, empty for none."""
        return self.baseline.point

    @property
    def sources(self) -> tuple[BaselineSource, ...]:
        """The recordings that it was learned from, of all operating points."""
        return tuple(source for member in self.baseline.per_point for source in member.sources)

    @property
    def units(self) -> tuple[str, str]:
        """Units of y and u."""
        y, u = self.baseline.loop.plant.units
        return y, u

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the coefficients of its plant."""
        return tuple(self.baseline.loop.plant.coefficient_units)

    @cached_property
    def fault_words(self) -> Mapping[str, str]:
        """What the names of its faults mean."""
        return {fault.name: fault.words for fault in self.baseline.loop.plant.all_faults}

    @property
    def loop_baseline(self) -> Baseline:
        """The baseline."""
        return self.baseline

    def at(self, point: str) -> LoopMachine:
        """Return it at an operating point; raises BaselineError if it has no such point."""
        return LoopMachine(self.baseline.at(point))

    def summary(self) -> Mapping[str, Any]:
        """Return what was learned, as plain values."""
        from servoscope.report import plain_values

        return plain_values.baseline_summary(self.baseline)

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]], list[str]]:
        """Return the coefficients as a table, and notes."""
        values = zip(self.baseline.names, self.baseline.theta, strict=True)
        rows: list[tuple[str, ...]] = [(name, f"{value:.4g}") for name, value in values]
        return ("coefficient", "value"), rows, [str(note) for note in self.baseline.notes]

    def checks(self, fault: str) -> tuple[Message, ...]:
        """Return what to check for one of its faults."""
        from servoscope.diagnosis.checks import checks_of_fault

        return tuple(checks_of_fault(self.baseline.loop, fault))

    def follower(self) -> Monitor:
        """Return the monitor; raises BaselineError if the operating point is not chosen."""
        from servoscope.diagnosis.monitor import Monitor

        return Monitor(self.baseline)

    def read(self, source: str | Path) -> Recording:
        """Read a whole log; raises RecordingError if it cannot be used."""
        from servoscope.signals import readers

        return readers.read(source, self.baseline.loop)

    def judge(self, log: Recording, progress: Callable[[str], None]) -> LogDiagnosis:
        """Diagnose a recording, refit included."""
        from servoscope.diagnosis.diagnose import diagnose_with_trace
        from servoscope.diagnosis.motion_signature import signature_columns
        from servoscope.report import plain_values
        from servoscope.report.diagnosis_page import write_diagnosis_page

        progress("recursion")
        diagnosis, trace = diagnose_with_trace(self.baseline, log, progress)
        used = self.baseline.at(diagnosis.point) if diagnosis.point else self.baseline

        def write_report(path: Path, baseline: str, recording: str) -> None:
            origin = plain_values.provenance(used, Path(baseline), Path(recording))
            write_diagnosis_page(path, diagnosis, trace, log, used.loop, origin)

        plant, since = used.loop.plant, diagnosis.onset_s[1] if diagnosis.onset_s else None
        data = {
            "words": {fault.name: fault.words for fault in plant.all_faults},
            "units": plant.units,
            "signals": recording_columns(log),
            "trace": _trace_columns(trace, plant.coefficient_units),
            "signature": signature_columns(log, used.loop, since),
        }
        return LogDiagnosis(diagnosis, data, used.hash, write_report)

    def judge_window(self, name: str, signals: FloatArray) -> WindowDiagnosis:
        """Diagnose a window after an alarm, refit included; the motion signature is the detail ``signature``."""
        from servoscope.detection.covariate_monitor import window_recording
        from servoscope.diagnosis.diagnose import diagnose
        from servoscope.diagnosis.motion_signature import signature_columns
        from servoscope.diagnosis.verify import provenance

        recording, start = window_recording(self.baseline, name, signals)
        diagnosis = diagnose(self.baseline, recording, before="suspect")  # the monitor has raised an alarm over minutes
        diagnosis = diagnosis.model_copy(update={"provenance": provenance(self.baseline, recording)})
        since = diagnosis.onset_s[1] if diagnosis.onset_s is not None else None
        return WindowDiagnosis(
            diagnosis, start, None, {"signature": signature_columns(recording, self.baseline.loop, since)}
        )


def recording_columns(recording: Recording) -> dict[str, list[float | None]]:
    """Return the signals as columns that can be drawn."""
    from servoscope.report.downsample import signal_columns

    return signal_columns(recording.t, (recording.r, recording.u, recording.y), SIGNAL_POINTS)


def _trace_columns(trace: Trace, units: Sequence[str]) -> dict[str, Any]:
    """Return the evaluations as columns: tests, iFRF and coefficients, each beside what is healthy."""
    from servoscope.estimation.frequency_response import ResponseRow, response_rows
    from servoscope.report.downsample import downsample_indices, json_numbers

    excess = np.where(trace.ready, trace.statistic / trace.threshold, np.nan)
    at = downsample_indices((excess, trace.level), TRACE_POINTS)
    std = np.sqrt(np.maximum(np.diagonal(trace.covariance, axis1=1, axis2=2), 0.0))
    rows = response_rows(trace.ifrf, trace.ifrf_expected, at)
    tests = {"t": trace.t, "statistic": excess, "level": trace.level}
    coefficients = {"value": trace.theta, "std": std, "nominal": trace.expected}
    responses = [
        {
            "frequency_hz": f,
            **{name: json_numbers(rows[:, i, k + 1]) for k, name in enumerate(ResponseRow._fields[1:5])},
        }
        for i, f in enumerate(trace.ifrf.frequencies.tolist())
    ]
    parameters = [
        {
            "name": name,
            "unit": unit,
            **{key: json_numbers(coefficient[at, i]) for key, coefficient in coefficients.items()},
        }
        for i, (name, unit) in enumerate(zip(trace.names, chain(units, repeat("")), strict=False))
    ]
    columns = {key: json_numbers(test[at]) for key, test in tests.items()}
    return {**columns, "responses": responses, "parameters": parameters}
