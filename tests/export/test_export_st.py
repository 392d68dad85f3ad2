"""The exported function block, translated back to Python and run beside the monitor.

Neither Debian nor PyPI nor npm has a compiler of Structured Text, so that its grammar is checked by the
translation alone, which knows few statements, and demands that every name is declared.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from commands import run
from hypothesis import given
from hypothesis import strategies as st
from structured_text import FunctionBlock
from test_export import altered, demo, fresh, without_sequential_test

from servoscope.baseline.baseline import Baseline
from servoscope.core.jit import symbolic
from servoscope.core.jit.st_source import st_literal
from servoscope.detection.statistic import apply_alarm_delays
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation import moments, recursion
from servoscope.estimation.kernel import cusum, sample_steps
from servoscope.estimation.kernel import run as kernels
from servoscope.export import export_st
from servoscope.export.golden import golden_signals

SAMPLES = 3000


def rows_of(block: FunctionBlock, signals: Any, frequencies: int) -> npt.NDArray[np.float64]:
    """Return the evaluations of a function block: statistic, level, theta, covariance, response, verdict."""
    rows = []
    for r, u, y, restart in zip(*signals, strict=True):
        valid = bool(np.isfinite([r, u, y]).all())
        if block(signal_r=float(r), signal_u=float(u), signal_y=float(y), valid=valid, restart=bool(restart)):
            v = block.variables
            parts = [v["response"][6 * f + part] for part in (0, 1) for f in range(frequencies)]
            rows.append([v["statistic"], v["level"], *v["theta"], *v["covariance"], *parts, v["verdict"]])
    return np.array(rows)


def test_bits_of_the_monitor_without_fused_multiply_adds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaps, NaN and restarts are among the samples."""
    signals, text = golden_signals(demo(), 1000), export_st(demo())
    for module in (symbolic, moments, sample_steps, cusum):
        monkeypatch.setattr(module, "fma", lambda a, b, c: a * b + c)
    monkeypatch.setattr(recursion, "compile_function", kernels.compile_function.__wrapped__)
    monitor = Monitor(demo())
    _, trace = monitor.run(monitor.init(), *signals)
    rows = np.column_stack([trace.statistic, trace.level, trace.theta, trace.covariance.reshape(len(trace.t), -1)])
    expected = np.column_stack([rows, trace.ifrf.H.real, trace.ifrf.H.imag])
    found = rows_of(FunctionBlock(text), signals, len(demo().loop.monitor.frequencies))
    assert found[:, :-1].tobytes() == expected.tobytes()


@pytest.mark.parametrize("settings", [{}, {"on_delay": 0.3, "off_delay": 1.5}, {"sequential_step": "update"}], ids=str)
def test_verdicts_of_the_monitor(settings: dict[str, Any]) -> None:
    """The numbers differ by rounding, the verdicts and the time of the alarm not at all."""
    baseline = fresh(altered(demo(), **settings))
    signals, monitor = golden_signals(baseline, SAMPLES), Monitor(baseline)
    _, trace = monitor.run(monitor.init(), *signals)
    block = FunctionBlock(export_st(baseline))
    found = rows_of(block, signals, len(baseline.loop.monitor.frequencies))
    assert np.allclose(found[:, 0], trace.statistic, rtol=1e-9, atol=0.0)
    assert np.allclose(found[:, 2 : 2 + len(baseline.names)], trace.theta, rtol=1e-9, atol=0.0)
    alarm = apply_alarm_delays(trace.exceeded, *baseline.pipeline().delays)
    assert found[:, -1].tolist() == np.where(np.asarray(trace.ready), np.where(alarm, 2, 1), 0).tolist()
    assert 2 in found[:, -1]
    assert block.variables["crossed_s"] == trace.crossed[-1]


def test_without_the_sequential_test() -> None:
    baseline = without_sequential_test(demo())
    signals, monitor = golden_signals(baseline, SAMPLES), Monitor(baseline)
    _, trace = monitor.run(monitor.init(), *signals)
    block = FunctionBlock(export_st(baseline))
    found = rows_of(block, signals, len(baseline.loop.monitor.frequencies))
    assert np.allclose(found[:, 0], trace.statistic, rtol=1e-9, atol=0.0)
    assert block.variables["crossed_s"] == -1.0


def test_state_is_retained_through_power_loss() -> None:
    """What is not retained begins anew, and the samples behind it are taken as not following."""
    text, (r, u, y, _) = export_st(demo()), golden_signals(demo(), 900)
    there, again = FunctionBlock(text), FunctionBlock(text)
    signals = [np.nan_to_num(x, posinf=0.0).tolist() for x in (r, u, y)]
    for k, (one_r, one_u, one_y) in enumerate(zip(*signals, strict=True)):
        if k == 700:  # power returns here
            again.variables |= {
                name: value.copy() if isinstance(value, list) else value
                for name, value in there.variables.items()
                if name in there.sections["VAR RETAIN"]
            }
        there(signal_r=one_r, signal_u=one_u, signal_y=one_y, restart=k == 700)
        if k >= 700:
            again(signal_r=one_r, signal_u=one_u, signal_y=one_y)
    assert again.variables["numbers"] == there.variables["numbers"]
    assert again.variables["statistic"] == there.variables["statistic"]


def test_every_temporary_is_written_before_it_is_read() -> None:
    """A controller keeps temporaries from call to call, and would hide that."""
    body = export_st(demo()).split("END_VAR")[-1]
    body = re.sub(r"\(\*.*?\*\)", "", body, flags=re.DOTALL)
    written: set[str] = set()
    for line in body.splitlines():
        target, _, value = line.strip().partition(" := ")
        assert set(re.findall(r"\b[tbkx]\d+\b", value or target)) <= written, line
        written.add(target)


@pytest.mark.parametrize("estimator", ["iv-akf", "kf", "rls", "rls-reset", "dfrls", "nlms", "sliding-window"])
def test_estimators_with_a_covariance_of_their_own(estimator: str) -> None:
    baseline = fresh(altered(demo(), estimator=estimator, memory=2.0))
    signals, monitor = golden_signals(baseline, 700), Monitor(baseline)
    _, trace = monitor.run(monitor.init(), *signals)
    found = rows_of(FunctionBlock(export_st(baseline)), signals, len(baseline.loop.monitor.frequencies))
    assert np.allclose(found[:, 0], trace.statistic, rtol=1e-6, atol=0.0)
    assert np.allclose(found[:, 2 : 2 + len(baseline.names)], trace.theta, rtol=1e-6, atol=0.0)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_literals_are_exact(number: float) -> None:
    text = st_literal(number)
    assert re.fullmatch(r"-?\d+\.\d+(E-?\d+)?", text)
    assert np.float64(text).tobytes() == np.float64(number).tobytes()


def test_command(tmp_path: Path) -> None:
    demo().save(tmp_path / "baseline.json")
    result = run("export", tmp_path / "baseline.json", "--st", tmp_path / "out", "--name", "axis")
    assert result.code == 0, result.err
    text = (tmp_path / "out" / "axis.st").read_text(encoding="utf-8")
    assert text == export_st(Baseline.load(tmp_path / "baseline.json"), "axis")
    assert FunctionBlock(text).name == "axis"
