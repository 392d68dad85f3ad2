"""The protocol of a machine: all that services, pages, fleets and commands know of a baseline."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.records import BaselineSource
from servoscope.core.arrays import FloatArray
from servoscope.core.messages import Message
from servoscope.diagnosis.monitor import Monitor
from servoscope.diagnosis.result import Diagnosis
from servoscope.models.loop import Loop

Catch: TypeAlias = Callable[[], AbstractContextManager[None]]
CHECKS = {  # what every machine guarantees; tests/machines/test_machine_contract.py runs them for each kind
    "file": "a baseline that is saved and loaded, or printed and parsed, has the same hash",
    "names": "each fault has words; a diagnosis names no other",
    "points": "a point that it does not have is refused in one line",
    "log": "its own healthy log, read and judged, is healthy",
    "window": "the same log as a window of samples is healthy, with the time of its beginning",
    "report": "the report on a log is one page that names it",
}


class WindowDiagnosis(NamedTuple):
    """The diagnosis of one of many windows of samples."""

    diagnosis: Diagnosis
    start: float  # when the diagnosis' time is 0 [s]
    evidence: float | None  # of a change, over its limit; None where nothing could be judged
    details: dict[str, Any]  # that the store keeps beside the diagnosis, by key


class LogDiagnosis(NamedTuple):
    """The diagnosis of a log, and what pages and reports show of it."""

    diagnosis: Diagnosis
    data: dict[str, Any]  # by key of a stored diagnosis, plain values
    hash: str  # of the baseline that was used
    write_report: Callable[[Path, str, str], None]  # to a file, with the names of baseline and log


class Machine(Protocol):
    """A machine of one kind with its baseline; `load`, `parse` and `learn` are of the class.

    A package offers a kind as an entry point of the group ``servoscope.machines``: its name, which loop files give as
    ``kind``, and the class. The files of its baselines begin with ``"format": "servoscope-KIND-baseline"``.
    """

    @classmethod
    def load(cls, path: str | Path) -> Machine:
        """Read the file of a baseline; raises BaselineError if it cannot be used."""

    @classmethod
    def parse(cls, text: str) -> Machine:
        """Return what `to_json` has written."""

    @classmethod
    def learn(cls, loop: Path, logs: Sequence[Path], catch: Catch) -> Machine:
        """Learn from healthy logs and a loop file; each log is read within a context of `catch`, so that others go on.

        Raises ServoscopeError if nothing can be learned.
        """

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind."""

    def to_json(self) -> str:
        """Return the baseline as text."""

    @property
    def kind(self) -> str:
        """Its kind; of a loop that of its plant."""

    @property
    def name(self) -> str:
        """Of the loop file."""

    @property
    def hash(self) -> str:
        """A digest of the baseline."""

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""

    @property
    def carrier(self) -> Loop:
        """The loop whose columns its logs and messages have."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the signals that its samples have beside r, u and y."""

    @property
    def needs_channels_alone(self) -> bool:
        """Whether r, u and y count for nothing, and all its channels must come in one message."""

    @property
    def points(self) -> tuple[str, ...]:
        """Names of its operating points."""

    @property
    def point(self) -> str:
        """Its operating point, empty for none."""

    @property
    def sources(self) -> tuple[BaselineSource, ...]:
        """The recordings that it was learned from."""

    @property
    def units(self) -> tuple[str, str] | None:
        """Units of y and u; None where there are no such signals."""

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the coefficients of its diagnoses, in their order."""

    @property
    def fault_words(self) -> Mapping[str, str]:
        """What the names of its faults mean."""

    @property
    def loop_baseline(self) -> Baseline | None:
        """The baseline of a loop, for what loops alone have: traces, operating points, learning on, export."""

    def at(self, point: str) -> Machine:
        """Return it at an operating point; raises BaselineError if it has no such point."""

    def summary(self) -> Mapping[str, Any]:
        """Return what was learned, as plain values."""

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]], list[str]]:
        """Return what was learned as a table: its head, its rows, and notes."""

    def checks(self, fault: str) -> tuple[Message, ...]:
        """Return what to check for one of its faults."""

    def follower(self) -> Monitor | None:
        """Return what follows its samples; None: it is judged window by window, and is not known in between."""

    def read(self, source: str | Path) -> Any:
        """Read a whole log; raises RecordingError if it cannot be used."""

    def judge(self, log: Any, progress: Callable[[str], None]) -> LogDiagnosis:
        """Judge a log that `read` has returned; `progress` is told of each step."""

    def judge_window(self, name: str, signals: FloatArray) -> WindowDiagnosis:
        """Judge one of the windows that follow each other without end; `signals`: t, r, u, y and `channels`, by row.

        Raises RecordingError if the samples cannot be used.
        """
