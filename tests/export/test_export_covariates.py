"""Covariates in the exported monitor, against the one in Python."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from drives import Drive, compiler

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.covariates import CovariateModel, WarmUp
from servoscope.core.errors import BaselineError
from servoscope.diagnosis.monitor import Monitor
from servoscope.export import export_c, export_fmu, export_st, pack_image, unpack_image
from servoscope.export.golden import golden_covariates, golden_signals
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop

TOLERANCE = 1e-9  # of T^2: exp and the sums are rounded in another order there
NAMES = "temperature", "load"
KNOWN, UNKNOWN, OUTSIDE = range(3)
MOTOR = {
    "name": "motor",
    "sample_rate": 100.0,
    "plant": {"kind": "polynomial", "order": 2, "coefficients": {"inertia": 1.0, "viscous_friction": 10.0}},
    "controller": {"kind": "pi", "k_p": 60.0, "k_i": 20.0},
    "columns": {"covariates": {name: name for name in NAMES}},
    "monitor": {"covariate_hold_s": 1.0, "frequencies": [0.5, 1.0, 2.0]},
}


def moving() -> Baseline:
    """Return a baseline whose friction follows two covariates in proportion, and whose inertia one of them."""
    slopes = np.array([[-0.2, 0.0], [0.05, 0.01], [0.1, 0.03]])
    covariance = 1e-4 * (np.eye(6) + 0.2)
    model = CovariateModel(
        names=NAMES,
        low=(20.0, 0.0),
        high=(40.0, 3.0),
        degrees=(2, 1),
        proportional=(True, False),
        slopes=tuple(map(tuple, slopes.tolist())),
        covariance=tuple(map(tuple, covariance.tolist())),
    )
    baseline = nominal_baseline(Loop.from_dict(MOTOR))
    thresholds = baseline.thresholds.model_copy(update={"hypotheses": ()})
    return baseline.model_copy(update={"covariates": model, "thresholds": thresholds})


def followed(
    drive: Drive, signals: list[npt.NDArray[np.float64]], values: npt.NDArray[np.float64]
) -> npt.NDArray[np.void]:
    """Return the evaluations of samples, with values (N, k) of the covariates; those of NaN are not handed over."""
    edges = np.flatnonzero(~np.isnan(values).all(axis=1))
    found = []
    for begin, end in zip([0, *edges], [*edges, len(values)], strict=True):
        if begin in edges:
            drive.function("covariates")(drive.pointer(), np.ascontiguousarray(values[begin]).ctypes)
        found.append(drive.run(*(signal[begin:end] for signal in signals)))
    return np.concatenate(found)


def test_same_verdict_statistic_and_state_as_the_monitor(tmp_path: Path) -> None:
    baseline, samples = moving(), 6000
    signals = list(golden_signals(baseline, samples, seed=3))
    values = golden_covariates(baseline.covariates, samples)  # type: ignore[arg-type]
    values[2000:2250] = np.nan  # longer than a value holds
    values[1000:1500, 1] = np.nan
    monitor, drive = Monitor(baseline), Drive.built(baseline, tmp_path)
    state, trace = monitor.run(monitor.init(), *signals, channels=dict(zip(NAMES, values.T, strict=True)))
    out = followed(drive, signals, values)
    row, n, place = out["row"], len(baseline.names), out["padding"]
    assert np.allclose(row[:, 1], trace.statistic, rtol=TOLERANCE, atol=TOLERANCE)
    ready = place == KNOWN
    began = np.maximum.accumulate(ready)  # until then the monitor's block has the coefficients that it begins with
    assert np.allclose(row[began, 4 : 4 + n], trace.theta[began], rtol=TOLERANCE, atol=0.0)
    covariance = row[:, 4 + n : 4 + n + n * n].reshape(-1, n, n)
    assert np.allclose(covariance[ready], trace.covariance[ready], rtol=TOLERANCE, atol=1e-15)
    gamma = (trace.ifrf.H - trace.ifrf_expected.H)[ready]
    assert np.allclose(out["gamma"][ready], np.stack([gamma.real, gamma.imag], axis=-1), rtol=1e-6, atol=1e-9)
    assert ((row[:, 0] > 0.0) & ready).tolist() == trace.ready.tolist()
    assert set(place.tolist()) == {KNOWN, UNKNOWN, OUTSIDE} and set(out["verdict"].tolist()) == {0, 1, 2}
    assert not (trace.statistic == 0.0).all() and (out["verdict"][~ready] == 0).all()
    mark = drive.save()[-12:-4]
    there, exceeding, since = unpack_image(drive.save(), mark)
    assert np.allclose(there, state, rtol=TOLERANCE, atol=1e-12, equal_nan=True)
    assert drive.load(pack_image(mark, state, exceeding, since))
    again = dict(zip(NAMES, np.full((500, 2), (30.0, 1.0)).T, strict=True))
    _, after = monitor.run(state, *(signal[:500] for signal in signals), channels=again)
    rest = followed(drive, [signal[:500] for signal in signals], np.array([again[name] for name in NAMES]).T)
    assert np.allclose(rest["row"][:, 1], after.statistic, rtol=TOLERANCE, atol=TOLERANCE)


@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_self_test(tmp_path: Path, name: str) -> None:
    export_c(moving()).save(tmp_path)
    command = ["make", "-s", "-C", str(tmp_path), "check", f"CC={compiler(name)}", "CFLAGS=-O1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "T^2 within 1e-09" in done.stdout


def test_self_test_finds_another_slope(tmp_path: Path) -> None:
    export_c(moving()).save(tmp_path)
    source = tmp_path / "servo_monitor.c"
    text = source.read_text(encoding="utf-8")
    assert text.count((-0.2).hex()) == 1
    source.write_text(text.replace((-0.2).hex(), (-0.2000001).hex()), encoding="utf-8")
    command = ["make", "-s", "-C", str(tmp_path), "check", f"CC={compiler()}", "CFLAGS=-O1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert "WRONG" in done.stdout


def test_what_takes_no_covariates(tmp_path: Path) -> None:
    baseline = moving()
    with pytest.raises(
        BaselineError, match="function block takes r, u and y alone, this baseline has temperature, load"
    ):
        export_st(baseline)
    with pytest.raises(BaselineError, match="co-simulation unit takes r, u and y alone"):
        export_fmu(baseline, tmp_path / "unit.fmu")
    with pytest.raises(BaselineError, match="take double"):
        export_c(baseline, single=True)
    warm_up = WarmUp(time_constant_s=100.0, power=0.0, variance=1.0)
    update = {"names": ("warm_up",), "low": (0.0,), "high": (1.0,), "degrees": (1,), "warm_up": warm_up}
    update |= {"slopes": ((0.1, 0.0),), "covariance": ((1e-4, 0.0), (0.0, 1e-4))}
    hidden = baseline.covariates.model_copy(update=update)  # type: ignore[union-attr]
    with pytest.raises(BaselineError, match="hidden_warm_up = false"):
        export_c(baseline.model_copy(update={"covariates": hidden}))
