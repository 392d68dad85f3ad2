"""The exported monitor against the one in Python: the same bits, the same alarm, the same state."""

from __future__ import annotations

import ctypes
import functools
import re
import subprocess
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import axis_logs
import numpy as np
import numpy.typing as npt
import pytest
from commands import run
from drives import Drive, compiler
from hypothesis import given
from hypothesis import strategies as st

import servoscope as ss
from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError, StateError
from servoscope.detection.baseline_run import cusum_constants
from servoscope.detection.statistic import apply_alarm_delays
from servoscope.diagnosis.monitor import Monitor
from servoscope.estimation import estimators
from servoscope.export import export_c, pack_image, unpack_image
from servoscope.export.golden import frozen_signals, golden_signals
from servoscope.learning.learn import learn_baseline, nominal_baseline
from servoscope.models.loop import Loop
from servoscope.signals.quality import QualitySettings
from servoscope.simulation import FaultEvent, reference, simulate

AXIS: dict[str, Any] = {"kind": "polynomial", "order": 2, "coefficients": {"viscous_friction": 200.0, "inertia": 90.0}}
WITH_COVARIANCE = [
    name for name in estimators.estimator_names() if not hasattr(estimators.load_estimator(name), "steady_gain")
]
RIG = Path(str(files("servoscope").joinpath("simulation", "reference-rig.toml")))


def without_sequential_test(baseline: Baseline) -> Baseline:
    thresholds = baseline.thresholds.model_copy(update={"hypotheses": ()})
    return baseline.model_copy(update={"thresholds": thresholds})


@functools.cache
def demo() -> Baseline:
    """The baseline of ``servoscope demo``."""
    loop = Loop.load(RIG)
    return ss.learn(loop, [simulate(loop, reference("profile", 60.0, 100.0), seed=1)[0]])


@functools.cache
def drive(folder: Path, *options: str) -> Drive:
    return Drive.built(demo(), folder, *options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drive")


def altered(baseline: Baseline, **monitor: Any) -> Baseline:
    """Return a baseline with other settings of its monitor."""
    settings = baseline.loop.to_dict()
    return baseline.model_copy(update={"loop_settings": settings | {"monitor": settings["monitor"] | monitor}})


def fresh(baseline: Baseline) -> Baseline:
    """Return a copy that has derived nothing yet."""
    return Baseline.model_validate(baseline.model_dump(by_alias=True))


def same(drive: Drive, baseline: Baseline, samples: int, seed: int = 1) -> None:
    """Run both over the same samples, with gaps, NaN and restarts, and compare all bits."""
    signals, monitor = golden_signals(baseline, samples, seed), Monitor(baseline)
    state, trace = monitor.run(monitor.init(), *signals)
    drive.function("init")(drive.pointer())
    out = drive.run(*signals)
    assert drive.state[:-2].tobytes() == state.tobytes()
    n, frequencies = len(baseline.names), trace.ifrf.H.shape[1]
    row = out["row"]
    assert len(row) == len(trace.t) > 0
    assert row[:, 1].tobytes() == trace.statistic.tobytes()
    assert row[:, 2].tobytes() == trace.level.tobytes()
    assert np.array_equal(row[:, 3], trace.crossed, equal_nan=True)
    assert row[:, 4 : 4 + n].tobytes() == trace.theta.tobytes()
    assert row[:, 4 + n : 4 + n + n * n].tobytes() == trace.covariance.tobytes()
    response = row[:, 4 + n + n * n :].reshape(-1, frequencies, 6)
    assert response[:, :, :2].tobytes() == np.stack([trace.ifrf.H.real, trace.ifrf.H.imag], axis=-1).tobytes()
    assert response[:, :, 2:].tobytes() == trace.ifrf.covariance.tobytes()
    gamma = trace.ifrf.H - trace.ifrf_expected.H
    assert np.array_equal(out["gamma"], np.stack([gamma.real, gamma.imag], axis=-1))
    alarm = apply_alarm_delays(trace.exceeded, *baseline.pipeline().delays)
    ready = np.asarray(trace.ready)
    assert out["verdict"].tolist() == np.where(ready, np.where(alarm, 2, 1), 0).tolist()


@pytest.mark.parametrize("options", [("-O2", "-ffp-contract=off"), ("-O0",)], ids=" ".join)
def test_hundred_thousand_samples_bit_for_bit(folder: Path, options: tuple[str, ...]) -> None:
    same(drive(folder, *options), demo(), 100_000)


def test_without_the_sequential_test(tmp_path: Path) -> None:
    baseline = without_sequential_test(demo())
    assert cusum_constants(baseline, baseline.pipeline()) is None
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


def test_with_a_step_of_the_sequential_test_at_each_update(tmp_path: Path) -> None:
    baseline = fresh(altered(demo(), sequential_step="update"))
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


def test_delays_of_the_alarm(tmp_path: Path) -> None:
    baseline = fresh(altered(demo(), on_delay=0.3, off_delay=1.5))
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", WITH_COVARIANCE)
def test_estimators_with_a_covariance_of_their_own(tmp_path: Path, estimator: str) -> None:
    baseline = fresh(altered(demo(), estimator=estimator))
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


def test_a_polynomial_plant_that_waits_at_rest(tmp_path: Path) -> None:
    loop = Loop.from_dict(
        {
            "name": "axis",
            "sample_rate": 200.0,
            "plant": AXIS | {"friction": "coulomb", "coefficients": AXIS["coefficients"] | {"coulomb_friction": 5.0}},
            "controller": {"kind": "pi", "k_p": 400.0, "k_i": 50.0},
            "monitor": {"update_when": "moving", "rest_speed": 1e-3},
        }
    )
    baseline = nominal_baseline(loop)
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


@pytest.mark.slow
@pytest.mark.parametrize("structure", ["tustin", "tustin-held"])
def test_other_structures(tmp_path: Path, structure: str) -> None:
    settings = Loop.load(RIG).to_dict()
    loop = Loop.from_dict(settings | {"monitor": settings.get("monitor", {}) | {"structure": structure}})
    baseline = learn_baseline(loop, [simulate(loop, reference("multisine", 60.0, 100.0), seed=1)[0]])
    same(Drive.built(baseline, tmp_path), baseline, 20_000)


def test_the_alarm_of_the_demo_comes_at_the_same_sample(folder: Path) -> None:
    loop = demo().loop
    suspect = simulate(loop, reference("profile", 60.0, 100.0), faults=[FaultEvent("C_ie", 1.2, 30.0)], seed=2)[0]
    diagnosis = ss.diagnose(demo(), suspect)
    monitor = drive(folder)
    monitor.function("init")(monitor.pointer())
    out = monitor.run(suspect.r, suspect.u, suspect.y, suspect.restart)
    crossed = out["row"][:, 3]
    first = crossed[np.isfinite(crossed)][0]
    assert diagnosis.detected_at_s is not None
    assert round(first * 100.0) == round(diagnosis.detected_at_s * 100.0)


@given(cuts=st.lists(st.integers(0, 3000), max_size=5))
def test_state_goes_from_drive_to_server_and_back(tmp_path_factory: Any, cuts: list[int]) -> None:
    """Samples are taken in turn in C and in Python, and the state goes through an image each time."""
    folder = tmp_path_factory.getbasetemp() / "in-turn"
    folder.mkdir(exist_ok=True)
    there, monitor = drive(folder), Monitor(demo())
    signals = golden_signals(demo(), 3000)
    whole, _ = monitor.run(monitor.init(), *signals)
    there.function("init")(there.pointer())
    mark = there.save()[-12:-4]
    for k, (begin, end) in enumerate(zip([0, *sorted(cuts)], [*sorted(cuts), 3000], strict=True)):
        piece = [signal[begin:end] for signal in signals]
        if k % 2:
            state, exceeding, since = unpack_image(there.save(), mark)
            state, _ = monitor.run(state, *piece)
            assert there.load(pack_image(mark, state, exceeding, since))
        else:
            there.run(*piece)
    assert there.state[:-2].tobytes() == whole.tobytes()


def test_a_damaged_image_changes_nothing(folder: Path) -> None:
    there = drive(folder)
    there.function("init")(there.pointer())
    there.run(*golden_signals(demo(), 500))
    before, image = there.state.copy(), bytearray(there.save())
    mark = bytes(image[-12:-4])
    image[100] ^= 4
    assert not there.load(bytes(image))
    assert there.state.tobytes() == before.tobytes()
    with pytest.raises(StateError, match="checksum"):
        unpack_image(bytes(image), mark)
    image[100] ^= 4
    with pytest.raises(StateError, match="another baseline"):
        unpack_image(bytes(image), b"12345678")


def test_state_of_the_demo_fits_into_two_kilobytes() -> None:
    made = export_c(demo())
    assert made.state_bytes <= 2048
    assert "malloc" not in made.files["servo_monitor.c"]


def run_alone(baseline: Baseline, folder: Path, signals: Any) -> npt.NDArray[Any]:
    """Return the evaluations of a monitor exported with `only_coefficients`."""
    return np.asarray(Drive.built(baseline, folder, only_coefficients=True).run(*signals)["row"])


def test_coefficients_alone_are_those_of_the_whole_monitor(tmp_path: Path) -> None:
    """The sequential test, which is left out, changes no coefficient and no T^2."""
    signals, monitor = golden_signals(demo(), 20_000), Monitor(demo())
    _, trace = monitor.run(monitor.init(), *signals)
    row, n = run_alone(demo(), tmp_path, signals), len(demo().names)
    assert row[:, 1].tobytes() == trace.statistic.tobytes()
    assert row[:, 4 : 4 + n].tobytes() == trace.theta.tobytes()
    assert not row[:, 2].any() and trace.level.any()


def behind_a_valve_law() -> Baseline:
    settings = demo().loop.to_dict()
    settings["plant"] |= {"valve_law": "square-root"}
    return fresh(demo().model_copy(update={"loop_settings": settings}))


def behind_two_stages() -> Baseline:
    loop = Loop.from_dict(Loop.load(RIG).to_dict() | {"monitor": {"two_stage": "adaptive"}})
    return learn_baseline(loop, [simulate(loop, reference("multisine", 60.0, 100.0), seed=1)[0]])


@pytest.mark.parametrize("made", [behind_a_valve_law, pytest.param(behind_two_stages, marks=pytest.mark.slow)])
def test_coefficients_alone_behind_a_stage_of_the_input(tmp_path: Path, made: Callable[[], Baseline]) -> None:
    """The caller hands u over as it is behind the stage."""
    baseline = made()
    r, u, y, restart = golden_signals(baseline, 20_000)
    monitor = Monitor(baseline)
    _, trace = monitor.run(monitor.init(), r, u, y, restart)
    one = [np.atleast_2d(x) for x in (r, u, y, restart)]
    behind = monitor._apply_input_stages(np.atleast_2d(monitor.init()).copy(), *one)[0]
    assert not np.array_equal(behind, u, equal_nan=True)
    row, n = run_alone(baseline, tmp_path, (r, behind, y, restart)), len(baseline.names)
    assert row[:, 1].tobytes() == trace.statistic.tobytes()
    assert row[:, 4 : 4 + n].tobytes() == trace.theta.tobytes()


@functools.cache
def with_features() -> Baseline:
    """An axis with friction, learned from as many recordings as features need."""
    return ss.learn(axis_logs.LOOP, [axis_logs.axis(seed) for seed in range(4)])


def test_coefficients_alone_beside_features(tmp_path: Path) -> None:
    baseline = with_features()
    assert baseline.features is not None
    signals, monitor = golden_signals(baseline, 20_000), Monitor(baseline)
    _, trace = monitor.run(monitor.init(), *signals)
    row, n = run_alone(baseline, tmp_path, signals), len(baseline.names)
    assert row[:, 1].tobytes() == trace.statistic.tobytes()
    assert row[:, 4 : 4 + n].tobytes() == trace.theta.tobytes()
    assert "no sequential test and no features" in (tmp_path / "servo_monitor.h").read_text(encoding="utf-8")


class TestSinglePrecision:
    """Floats, with the bits of the monitor in single precision."""

    def test_bit_for_bit(self, tmp_path: Path) -> None:
        r, u, y, restart = golden_signals(demo(), 50_000, seed=1)
        u[np.abs(u) > 1e100] = np.nan  # the same gap, and no warning that it overflows
        monitor = Monitor(demo(), precision="single")
        state, trace = monitor.run(monitor.init(), r, u, y, restart)
        there = Drive.built(demo(), tmp_path, single=True)
        out = there.run(r, u, y, restart)
        row, n = out["row"], len(demo().names)
        assert row[:, 1].tobytes() == trace.statistic.tobytes()
        assert row[:, 2].tobytes() == trace.level.tobytes()
        assert row[:, 4 : 4 + n].tobytes() == trace.theta.tobytes()
        image = there.save()
        assert unpack_image(image, image[-12:-4])[0].tobytes() == state.tobytes()
        assert there.load(pack_image(image[-12:-4], state, 0.0, 0.0))
        alarm = apply_alarm_delays(trace.exceeded, *demo().pipeline().delays)
        assert out["verdict"].tolist() == np.where(np.asarray(trace.ready), np.where(alarm, 2, 1), 0).tolist()

    def test_self_test(self, tmp_path: Path) -> None:
        made = export_c(demo(), single=True)
        made.save(tmp_path)
        assert made.state_bytes < export_c(demo()).state_bytes
        done = subprocess.run(
            ["make", "-s", "-C", tmp_path, "check", f"CC={compiler()}", "CFLAGS=-O1"],
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert f"state {made.state_bytes} bytes" in done.stdout

    def test_its_error_is_said_and_refused_where_it_is_too_large(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found = re.search(r"a factor of ([\d.]+) in the rate", export_c(demo(), single=True).files["servo_monitor.h"])
        assert found and 1.0 <= float(found[1]) < 1.1
        monkeypatch.setattr("servoscope.export.golden.MAX_FACTOR", 1.0)
        with pytest.raises(BaselineError, match="in single precision T"):
            export_c(demo(), single=True)

    def test_other_estimators_are_refused(self) -> None:
        with pytest.raises(BaselineError, match=r"estimator = 'iv-akf'.*single"):
            export_c(fresh(altered(demo(), estimator="iv-akf")), single=True)


class TestRefusals:
    """What cannot be exported is named."""

    def test_two_stages(self) -> None:
        with pytest.raises(BaselineError, match=r"two_stage = 'adaptive'"):
            export_c(fresh(altered(demo(), two_stage="adaptive")))

    def test_a_valve_law(self) -> None:
        settings = demo().loop.to_dict()
        settings["plant"] |= {"valve_law": "square-root"}
        with pytest.raises(BaselineError, match=r"valve_law = 'square-root'"):
            export_c(fresh(demo().model_copy(update={"loop_settings": settings})))

    def test_features(self) -> None:
        with pytest.raises(BaselineError, match=r"features cannot be exported.*= 0, or give --only-coef"):
            export_c(with_features())

    def test_pressures(self) -> None:
        """Those of a cylinder show what its coefficients do not: an export must not drop them unasked."""
        with pytest.raises(BaselineError, match=r"pressures cannot be exported: give --only-coef"):
            export_c(demo().model_copy(update={"pressures": object()}))

    def test_operating_points(self) -> None:
        other = demo().model_copy(update={"point": "warm"})
        with pytest.raises(BaselineError, match="--point cold"):
            export_c(demo().model_copy(update={"point": "cold", "others": (other,)}))

    def test_a_name_that_is_none_of_c(self) -> None:
        with pytest.raises(BaselineError, match="prefix"):
            export_c(demo(), "Axis 3")


def test_command(tmp_path: Path) -> None:
    demo().save(tmp_path / "baseline.json")
    result = run("export", tmp_path / "baseline.json", "--c", tmp_path / "out", "--name", "axis")
    assert result.code == 0, result.err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("axis.c", "axis.h", "axis_golden.h", "check.c", "Makefile")
    }
    assert "make -C" in result.out.replace("\n", " ")


def test_motions_never_seen_are_the_servers(tmp_path: Path) -> None:
    """Where the model is known to hold under the motions of the recordings alone, header and terminal say so."""
    baseline = without_sequential_test(with_features()).model_copy(update={"features": None, "exact": None})
    assert baseline.limited_motion is not None and demo().limited_motion is None
    baseline.save(tmp_path / "baseline.json")
    result = run("export", tmp_path / "baseline.json", "--c", tmp_path)
    assert result.code == 0, result.err
    for text in (" ".join(result.out.split()), (tmp_path / "servo_monitor.h").read_text(encoding="utf-8")):
        assert "an alarm may be no fault: the server looks at that" in text
    assert "an alarm may" not in export_c(demo()).files["servo_monitor.h"]


@pytest.mark.parametrize("held", ["r", "u", "y", "none"])
def test_frozen_signals_are_those_of_data_quality(folder: Path, held: str) -> None:
    """At each of 100 000 samples, over ranges that are forgotten in between, with rests, noise, NaN and infinities."""
    baseline, rng = demo(), np.random.default_rng(5)
    signals = dict(zip("ruy", golden_signals(baseline, 100_000)[:3], strict=True))
    for begin in rng.integers(0, 98_000, 20 if held != "none" else 0):
        stretch = slice(int(begin), int(begin) + int(rng.integers(400, 2000)))
        signals[held][stretch] = signals[held][begin]
        if held == "r":  # a y that is noisy at rest, and then quiet
            signals["y"][stretch] = signals["r"][begin] + 1e-6 * np.round(
                20.0 * rng.standard_normal(stretch.stop - stretch.start)
            )
    with np.errstate(over="ignore"):
        expected = frozen_signals(QualitySettings().limits(100.0), *signals.values())
    compiled, state = drive(folder), ctypes.create_string_buffer(1024)
    compiled.function("signals_init")(state)
    found = compiled.function("frozen")
    found.argtypes = [ctypes.c_void_p, *[ctypes.c_double] * 3]
    samples = np.column_stack(list(signals.values())).tolist()
    assert [found(state, *sample) for sample in samples] == expected.tolist()
    assert set(expected.tolist()) >= {"r": {0}, "u": {0, 2}, "y": {0, 1}, "none": {0}}[held]
