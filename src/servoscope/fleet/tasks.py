"""The tasks of a fleet, which any engine can run, the engine of one machine, and results as rows of equal columns."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servoscope.core.errors import NotEnoughError, ServoscopeError
from servoscope.core.files import atomic_write, make_folder
from servoscope.core.workers import Progress, WorkerError, Workers
from servoscope.fleet.baselines import load_day_monitor
from servoscope.fleet.day_monitor import DayMonitor, DayState, EvaluationBlock, RowHistory
from servoscope.fleet.lake import POINT, AssetDay
from servoscope.fleet.read import read_blocks
from servoscope.fleet.rows import MICRO, Rows
from servoscope.machines.kinds import LOOP, kind_of_file, load_cached
from servoscope.machines.protocol import Machine
from servoscope.models.loop import Columns, Loop
from servoscope.signals import Recording

RESULT_COLUMNS = {
    **dict.fromkeys(("asset", "day", "status", "error", "verdict", "fault", "parameter"), "string"),
    **dict.fromkeys(("ratio", "low", "high", "probability", "peak"), "double"),
    **dict.fromkeys(("first_us", "last_us", "alarm_us", "samples", "gaps", "missing", "repeats"), "long"),
    **dict.fromkeys(("summary", "result"), "string"),
}


def result_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result as one row of `RESULT_COLUMNS`; ``result`` is all of it, as JSON."""
    diagnosis = entry.get("diagnosis", {})
    fault: Mapping[str, Any] = next(iter(diagnosis.get("faults") or ()), {})
    low, high = fault.get("interval", (None, None))
    known = {"low": low, "high": high, "fault": fault.get("name"), "result": json.dumps(entry)}
    known |= {name: fault.get(name) for name in ("parameter", "ratio")}
    known |= {name: diagnosis.get(name) for name in ("verdict", "probability", "summary")}
    return {name: known[name] if name in known else entry.get(name) for name in RESULT_COLUMNS}


def result_table(entries: Sequence[Mapping[str, Any]]) -> Any:
    """Return results as one Arrow record batch."""
    import pyarrow as pa

    types = {"string": pa.string(), "double": pa.float64(), "long": pa.int64()}
    schema = pa.schema([(name, types[kind]) for name, kind in RESULT_COLUMNS.items()])
    return pa.RecordBatch.from_pylist([result_row(entry) for entry in entries], schema)


@dataclass(frozen=True)
class LearnTask:
    """Learn a baseline from some items, and write it to a file."""

    name: str  # of the asset, or of the group of assets
    items: tuple[AssetDay, ...]
    loop: Loop  # settings, with the columns
    output: str  # the baseline's file
    max_s: float  # seconds of each item that are used
    population: tuple[str, ...] = ()  # files of the baselines of like machines

    @property
    def key(self) -> str:
        """What identifies its result."""
        return self.name

    def run(self) -> dict[str, Any]:
        """Learn; items that cannot be used are left out and named."""
        from servoscope.diagnosis.operating_points import learn

        unused: dict[str, str] = {}
        recordings: list[Recording] = []
        for item in self.items:
            try:
                recordings.append(self._read(item))
            except Exception as error:  # whatever is wrong with one item must not cost the others
                unused[f"{item.asset} {item.day}"] = error_text(error)
        try:
            if not recordings:
                raise NotEnoughError("; ".join(f"{name}: {reason}" for name, reason in unused.items()))
            # what this machine was itself would count twice
            others = [file for file in self.population if Path(file).name != Path(self.output).name]
            learn(self.loop, recordings, population=others).save(self.output)
        except Exception as error:
            return {"name": self.name, "error": error_text(error), "unused": unused}
        return {"name": self.name, "error": None, "unused": unused}

    def _read(self, item: AssetDay) -> Recording:
        parts: list[Rows] = []
        for rows in read_blocks(item.files, self.loop.columns):
            parts.append(rows)
            if rows.t_us[-1] - parts[0].t_us[0] > self.max_s * MICRO:
                break
        rows = Rows.concatenate(parts)
        if not len(rows):
            raise NotEnoughError("holds no rows")
        first_us = int(rows.t_us[0])
        rows = rows.between(first_us - 1, int(first_us + self.max_s * MICRO))
        return rows.to_recording(first_us, self.loop, f"{item.asset} {item.day}")


@dataclass(frozen=True)
class ExamineTask:
    """Follow one item and diagnose it; write its trace."""

    item: AssetDay
    baseline: str | None  # file of the baseline; None: there is none
    baseline_error: str  # why there is none
    assets: int  # how many assets share the budget of false alarms
    columns: Columns | None  # where the signals are; None: where the baseline's loop says
    window_s: float  # seconds of raw rows that a diagnosis covers
    trace: str | None  # Parquet file of the trace; None: it is not written

    @property
    def key(self) -> tuple[str, str]:
        """What identifies its result."""
        return self.item.key

    def run(self) -> dict[str, Any]:
        """Return the result as plain values."""
        try:
            if self.baseline is None:
                raise ServoscopeError(f"no baseline: {self.baseline_error}")
            point = dict(self.item.groups).get(POINT)
            if kind_of_file(self.baseline) != LOOP:
                return self._stamp(self._examine_windows(load_cached(Path(self.baseline)), point))
            monitor = load_day_monitor(self.baseline, self.assets, self.window_s, point)
            learned = monitor.baseline.loop.columns
            columns = self.columns if self.columns is not None else learned
            if not columns.covariates:  # --columns says where r, u and y are
                columns = columns.model_copy(update={"covariates": learned.covariates})
            result, trace = examine_day(monitor, read_blocks(self.item.files, columns))
            if self.trace is not None and trace:
                make_folder(Path(self.trace).parent)
                atomic_write(self.trace, _encode_trace(trace))
            result = json.loads(json.dumps(result, allow_nan=False))
        except Exception as error:  # garbage in one item must not cost another
            result = failed_result(error)
        return self._stamp(result)

    def _examine_windows(self, machine: Machine, point: str | None) -> dict[str, Any]:
        from servoscope.fleet.window_day import examine_windows

        if self.columns is not None:
            raise ServoscopeError(f"--columns: leave out, the loop file of kind {machine.kind!r} names its columns")
        return examine_windows(machine if point is None else machine.at(point), self.item.files, self.window_s)

    def _stamp(self, result: Mapping[str, Any]) -> dict[str, Any]:
        return {"asset": self.item.asset, "day": self.item.day, "stamp": self.item.stamp, **result}


Task = LearnTask | ExamineTask
TaskResult = tuple[Task, dict[str, Any]]
Engine = Callable[[Sequence[Task]], Iterator[TaskResult]]  # results come as tasks finish, in any order


def local(jobs: int) -> Engine:
    """Return the engine that runs tasks in so many processes; with one, in this one."""

    def run(tasks: Sequence[Task]) -> Iterator[TaskResult]:
        if jobs == 1:
            yield from ((task, task.run()) for task in tasks)
            return
        for task, result in Workers().map(f"{__name__}:run_task", tasks, jobs):
            yield task, crash_result(task) if isinstance(result, WorkerError) else result

    return run


def run_task(_: Progress, task: Task) -> dict[str, Any]:
    """Run a task in a worker."""
    return task.run()


def crash_result(task: Task) -> dict[str, Any]:
    """Return the result of a task that killed its process."""
    error = "its process died, perhaps for want of memory"
    if isinstance(task, LearnTask):
        return {"name": task.name, "error": error, "unused": {}}
    return task._stamp({"status": "failed", "error": error})


def examine_day(monitor: DayMonitor, blocks: Iterable[Rows]) -> tuple[dict[str, Any], list[EvaluationBlock]]:
    """Return the result of a day, whose rows come in the order of time, and its trace."""
    state, history, trace = monitor.start(), RowHistory(), []
    for rows in blocks:
        history.blocks.append(rows)
        state, evaluations = monitor.advance(state, rows, history)
        history.drop_until(monitor.needed_since(state))
        trace.append(evaluations)
    return day_result(monitor, monitor.finish(state, history)), trace


def day_result(monitor: DayMonitor, state: DayState) -> dict[str, Any]:
    """Return what is known of a day that is over, as plain values."""
    error = "holds no rows" if state.result is None else state.result.get("error")
    if error is not None:
        return {"status": "failed", "error": error}
    counts = {name: getattr(state, name) for name in ("samples", "repeats", "missing", "gaps", "evaluations", "peak")}
    times = {"first_us": state.first_us, "last_us": state.last_us, "alarm_us": state.alarm_us}
    baseline = monitor.baseline.hash
    return {"status": "examined", "error": None, "baseline": baseline, **counts, **times, **(state.result or {})}


def failed_result(error: Exception) -> dict[str, Any]:
    """Return the result of a day that could not be examined."""
    return {"status": "failed", "error": error_text(error)}


def error_text(error: Exception) -> str:
    """Return an error in one line; with its type where it is none of servoscope's own."""
    text = " ".join(str(error).split())
    return text if isinstance(error, ServoscopeError) else f"{type(error).__name__}: {text[:200]}"


def _encode_trace(trace: Sequence[EvaluationBlock]) -> bytes:
    """Return a trace as a Parquet file with the columns time_us, theta_0 ..., statistic, threshold, level."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    time_us, theta, *tests = EvaluationBlock.concatenate(trace)
    names = ("time_us", *(f"theta_{i}" for i in range(theta.shape[1])), *EvaluationBlock._fields[2:])
    sink = io.BytesIO()
    pq.write_table(pa.table([time_us, *theta.T, *tests], names=list(names)), sink)
    return sink.getvalue()
