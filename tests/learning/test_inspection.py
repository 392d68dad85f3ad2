"""Inspection: what is wrong with a log is found with its numbers, what is sound is called usable, nothing crashes."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.core.errors import OutputError
from servoscope.estimation.reference_period import reference_period
from servoscope.learning.inspection import Inspection, inspect
from servoscope.learning.inspection.signals import quantisation
from servoscope.models.loop import Columns, Loop
from servoscope.report import inspection_figures, inspection_page
from servoscope.signals import Recording
from servoscope.signals.readers import read
from servoscope.simulation import reference, simulate

AXIS: dict[str, Any] = {
    "name": "axis",
    "sample_rate": 200.0,
    "plant": {
        "kind": "polynomial",
        "order": 2,
        "friction": "coulomb",
        "offset": True,
        "coefficients": {"viscous_friction": 1.0, "inertia": 0.03, "coulomb_friction": 0.1, "offset": 0.02},
    },
    "controller": {"kind": "pi", "k_p": 20.0, "k_i": 10.0},
}
EMPS = {
    "sample_rate": 1000.0,
    "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb", "offset": True, "input_gain": 35.15},
    "columns": {"time": "t", "reference": "qg", "input": "vir", "output": "qm"},
    "monitor": {"cutoff": 10.0},
}
PUMP = Columns(
    time="time", time_unit="ms", reference="ADC1_Channel_13", input="ADC1_Channel_8", output="ADC1_Channel_14"
)


def recorded(settings: dict[str, Any], kind: str = "profile", duration: float = 60.0, **noise: Any) -> Recording:
    loop = Loop.from_dict(settings)
    return simulate(loop, reference(kind, duration, loop.sample_rate), **noise)[0]


def kinds(inspection: Inspection, severity: str) -> set[str]:
    return {finding.kind for finding in inspection.findings if finding.severity == severity}


@pytest.mark.parametrize("kind", ["profile", "multisine"])
def test_a_sound_recording_is_usable_with_and_without_its_loop(rig: dict[str, Any], kind: str) -> None:
    recording = recorded(rig, kind)
    for loop in (Loop.from_dict(rig), None):
        found = inspect(recording, loop)
        assert found.verdict == "usable", found.summary
        assert found.fit is not None and found.fit.explained > 0.999
        assert found.free_run is not None and found.free_run.explained is not None
        assert found.free_run.explained > 0.999
        assert found.residual is not None and found.residual.white
        assert found.residual.repeating == pytest.approx(0.0, abs=0.1)
        assert found.residual.period_s == pytest.approx(10.0)
        assert found.residual.model_error < 0.003
        assert found.dead_zone is None and found.saturation is not None and found.saturation.source == "none"


@pytest.mark.parametrize("kind", ["profile", "multisine"])
@pytest.mark.parametrize("samples", [0.0, 0.4, 1.0])
def test_delay_is_found_within_a_tenth_of_a_sample(rig: dict[str, Any], kind: str, samples: float) -> None:
    recording = recorded({**rig, "delay": samples / 100.0}, kind)
    for loop in (Loop.from_dict(rig), None):
        delay = inspect(recording, loop).delay
        assert delay is not None and delay.samples is not None
        assert delay.samples == pytest.approx(samples, abs=0.1)
        assert delay.low_samples is not None and delay.high_samples is not None
        assert delay.high_samples - delay.low_samples < 0.1


def test_a_delay_that_the_loop_does_not_know_is_said_and_a_known_one_is_not(rig: dict[str, Any]) -> None:
    late = {**rig, "delay": 0.01}
    recording = recorded(late, "multisine")
    unknown = inspect(recording, Loop.from_dict(rig))
    assert unknown.verdict == "usable with care" and "delay" in kinds(unknown, "care")
    assert any(str(line).startswith("delay = 0.01") for line in unknown.recommendations)
    known = inspect(recording, Loop.from_dict(late))
    assert known.verdict == "usable" and known.delay is not None and known.delay.gain < 0.02


def test_u_logged_one_sample_late_is_a_negative_delay(rig: dict[str, Any]) -> None:
    recording = recorded(rig, "multisine")
    late = replace(recording, u=np.concatenate([recording.u[:1], recording.u[:-1]]))
    delay = inspect(late, Loop.from_dict(rig)).delay
    assert delay is not None and delay.samples == pytest.approx(-1.0, abs=0.1)


def test_delay_of_a_slow_motion_is_not_identifiable(rig: dict[str, Any]) -> None:
    t = np.arange(6000) / 100.0
    recording, _ = simulate(Loop.from_dict(rig), 0.05 * np.sin(2.0 * np.pi * 0.1 * t))
    delay = inspect(recording, Loop.from_dict({**rig, "controller": None, "plant": POLYNOMIAL_3})).delay
    assert delay is not None and not delay.identifiable and "not identifiable" in str(delay.words)


POLYNOMIAL_3 = {"kind": "polynomial", "order": 3, "stiffness": True}


@pytest.mark.parametrize(("step", "bits"), [(1e-3, 6.4), (1e-4, 9.7)])
def test_quantised_y_is_found(rig: dict[str, Any], step: float, bits: float) -> None:
    recording = recorded(rig, "multisine")
    coarse = replace(recording, y=step * np.round(recording.y / step))
    found = inspect(coarse, Loop.from_dict(rig))
    y = found.quantisation[2]
    assert y.step == pytest.approx(step, rel=1e-6)
    assert y.effective_bits == pytest.approx(bits, abs=0.1)
    assert ("quantisation" in kinds(found, "care")) == (step == 1e-3)
    assert found.quantisation[1].step is None


@pytest.mark.parametrize("step", [2.0 * np.pi / 2048, 0.1, 1e-6 / 3.0])
def test_the_step_of_rounded_files_is_the_sensors(step: float) -> None:
    x = step * np.cumsum(np.random.default_rng(1).integers(-2, 3, 5000))
    rounded = np.array([float(f"{value:.9g}") for value in x])
    assert quantisation("y", rounded).step == pytest.approx(step, rel=1e-5)
    assert quantisation("y", x + step * np.random.default_rng(2).normal(size=x.size)).step is None


def test_saturated_u_is_found_with_its_limits(rig: dict[str, Any]) -> None:
    settings = {**rig, "input_limits": [-0.03, 0.04]}
    recording = recorded(settings)
    at = np.mean(recording.u >= 0.04 - 1e-9)
    assert at > 0.01
    for loop, source in ((None, "seen"), (Loop.from_dict(settings), "loop")):
        seen = inspect(recording, loop).saturation
        assert seen is not None and seen.source == source
        assert (seen.low, seen.high) == (pytest.approx(-0.03), pytest.approx(0.04))
        assert seen.share_high == pytest.approx(at) and seen.share_low > 0.01
    assert any("input_limits" in str(line) for line in inspect(recording).recommendations)


def test_friction_that_the_model_lacks_makes_the_residual_structured_and_repeat() -> None:
    recording = recorded(AXIS, noise_u_std=1e-3, noise_y_std=1e-6)
    smooth = {**AXIS, "controller": None, "plant": {"kind": "polynomial", "order": 2, "offset": True}}
    right, wrong = inspect(recording, Loop.from_dict(AXIS)), inspect(recording, Loop.from_dict(smooth))
    assert right.residual is not None and wrong.residual is not None
    assert wrong.residual.relative > 1.5 * right.residual.relative
    assert wrong.residual.white is False
    assert wrong.residual.repeating is not None and wrong.residual.repeating > 0.95
    assert wrong.residual.model_error == pytest.approx(wrong.residual.relative, rel=0.1)
    assert "plant" in kinds(wrong, "care") and "plant" not in kinds(right, "care")
    generic = inspect(recording)
    assert generic.best_order is not None
    assert (generic.best_order.order, generic.best_order.friction) == (2, "coulomb")
    assert not generic.best_order.stiffness
    assert generic.fit is not None
    assert generic.fit.coefficients["coulomb_friction"].value == pytest.approx(0.1, rel=0.05)


def test_the_multisine_excites_20_hz_and_the_trapezoid_does_not(rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig)
    multisine, trapezoid = (inspect(recorded(rig, kind), loop) for kind in ("multisine", "trapezoid"))
    rich, poor = multisine.frequencies[2], trapezoid.frequencies[2]
    assert rich.frequency_hz == poor.frequency_hz == 20.0
    assert rich.snr is not None and poor.snr is not None and rich.snr > 30.0 > 1.0 > poor.snr
    assert rich.relative_std is not None and poor.relative_std is not None
    assert poor.relative_std > 10.0 * rich.relative_std
    assert multisine.band is not None and multisine.band.high_hz == pytest.approx(19.9, abs=0.5)
    assert trapezoid.band is not None and trapezoid.band.high_hz < 10.0
    assert trapezoid.verdict == "usable with care" and "frequency" in kinds(trapezoid, "care")


def test_the_relative_std_is_that_of_repeated_recordings(rig: dict[str, Any]) -> None:
    found = [inspect(recorded(rig, "multisine", seed=seed), Loop.from_dict(rig)) for seed in range(12)]
    theta = np.array([f.fit.coefficients["theta_1"].value for f in found if f.fit is not None])
    said = np.array([f.fit.coefficients["theta_1"].std for f in found if f.fit is not None])
    assert 0.5 < np.std(theta, ddof=1) / said.mean() < 2.0


@pytest.mark.parametrize("signal", ["u", "y"])
def test_a_constant_signal_is_not_usable(rig: dict[str, Any], signal: str) -> None:
    recording = recorded(rig)
    found = inspect(replace(recording, **{signal: np.full(recording.samples, 0.1)}), Loop.from_dict(rig))
    assert found.verdict == "not usable" and "constant" in kinds(found, "stop")
    json.dumps(found.model_dump(mode="json"), allow_nan=False)


@pytest.mark.parametrize("samples", [1, 2, 5, 19, 20, 40, 64, 120, 300])
def test_a_short_recording_says_so(rig: dict[str, Any], samples: int) -> None:
    recording = recorded(rig, "multisine").part(0.0, samples / 100.0 - 0.005)
    assert recording.samples == samples
    for loop in (Loop.from_dict(rig), None):
        found = inspect(recording, loop)
        assert "short" in {finding.kind for finding in found.findings}
        assert samples > 40 or found.verdict == "not usable"
        json.dumps(found.model_dump(mode="json"), allow_nan=False)
        inspection_page.render_inspection_page(found, recording)


def test_a_constant_reference_and_pure_noise_do_not_crash(rig: dict[str, Any]) -> None:
    still, _ = simulate(Loop.from_dict(rig), np.zeros(3000))
    found = inspect(still, Loop.from_dict(rig))
    assert found.verdict == "not usable" and "constant" in kinds(found, "care") and "rest" in kinds(found, "stop")
    assert [str(line) for line in found.recommendations] == ["record while the machine moves"]
    assert not {"frequency", "explained", "free_run", "band"} & {finding.kind for finding in found.findings}
    rng = np.random.default_rng(3)
    noise = replace(still, r=rng.normal(size=3000), u=rng.normal(size=3000), y=rng.normal(size=3000))
    assert inspect(noise).verdict == "not usable"


def test_swapped_and_reversed_columns_are_suspected(rig: dict[str, Any]) -> None:
    recording = recorded(rig, "multisine")
    swapped = inspect(replace(recording, u=recording.y, y=recording.u))
    assert swapped.verdict == "not usable" and "swapped" in kinds(swapped, "stop")
    scaled = inspect(replace(recording, u=1e3 * recording.y, y=recording.u))
    assert scaled.swapped is not None
    assert inspect(recording).swapped is None
    reversed_ = inspect(replace(recording, u=-recording.u))
    assert "sign" in kinds(reversed_, "care")


def test_a_motion_of_one_frequency_cannot_tell_inertia_from_stiffness(rig: dict[str, Any]) -> None:
    t = np.arange(6000) / 100.0
    recording, _ = simulate(Loop.from_dict(rig), 0.03 * np.sin(2.0 * np.pi * 2.0 * t))
    found = inspect(recording, Loop.from_dict({**rig, "controller": None, "plant": POLYNOMIAL_3}))
    assert "conditioning" in kinds(found, "care")
    assert found.fit is not None and found.fit.condition > 1e3 and " and " in found.fit.weakest


def test_gaps_and_other_defects_of_the_dirty_file_are_told(eha_cases: Path, rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig)
    found = inspect(read(eha_cases / "dirty_healthy.csv", loop), loop)
    assert found.verdict == "usable"
    assert {"nan", "repeat", "gap", "order", "spike"} <= {defect.kind for defect in found.defects}
    assert found.sampling.stretches == 5 and 0.5 < found.sampling.missing_percent < 1.0
    assert found.delay is not None and found.delay.samples == pytest.approx(0.0, abs=0.1)
    assert found.residual is not None and found.residual.white


@pytest.mark.parametrize("name", ["multisine_healthy_2", "profile_healthy_0", "trapezoid_healthy_4"])
def test_recordings_of_an_independent_simulator_are_in_step(eha_cases: Path, rig: dict[str, Any], name: str) -> None:
    recording = read(eha_cases / f"{name}.csv")
    for loop in (Loop.from_dict(rig), None):
        found = inspect(recording, loop)
        assert found.verdict != "not usable"
        assert found.delay is not None and found.delay.samples == pytest.approx(0.0, abs=0.2)
        assert "delay" not in kinds(found, "care")


def test_emps_is_explained_and_its_parameters_are_the_authors(shared_data: Path) -> None:
    loop = Loop.from_dict(EMPS)
    recording = read(shared_data / "real" / "emps" / "DATA_EMPS.mat", loop)
    found = inspect(recording, loop)
    assert found.verdict == "usable" and found.fit is not None
    values = {name: c.value for name, c in found.fit.coefficients.items()}
    assert values["inertia"] == pytest.approx(95.1, rel=0.01)
    assert values["viscous_friction"] == pytest.approx(203.5, rel=0.01)
    assert values["coulomb_friction"] == pytest.approx(20.39, rel=0.01)
    assert values["offset"] == pytest.approx(-3.165, rel=0.03)
    assert found.fit.explained > 0.998
    assert found.free_run is not None and (found.free_run.explained or 0.0) > 0.99
    assert found.residual is not None and found.residual.period_s == pytest.approx(6.24)
    assert (found.residual.repeating or 0.0) > 0.8 and 0.01 < found.residual.model_error < 0.05
    generic = inspect(recording)
    assert generic.best_order is not None
    assert (generic.best_order.order, generic.best_order.friction) == (2, "coulomb")
    told = next(str(finding.message) for finding in found.findings if finding.kind == "model_error")
    assert told.startswith("only if healthy recordings raise alarms: a model_error up to 0.03")
    assert "hides changes of inertia below about 3" in told
    assert not any("model_error" in str(line) for line in found.recommendations)
    assert found.headline == "usable to diagnose; short to learn from"


@pytest.mark.parametrize("half", [(0.0, 12.42), (12.42, 25.0)])
def test_two_periods_of_a_reference_do_not_tell_coherence(shared_data: Path, half: tuple[float, float]) -> None:
    loop = Loop.from_dict(EMPS)
    found = inspect(read(shared_data / "real" / "emps" / "DATA_EMPS.mat", loop).part(*half), loop)
    assert found.verdict == "usable" and found.band is None and found.periods == pytest.approx(2.0, abs=0.01)
    assert "coherence" in kinds(found, "note") and found.recommendations == ()
    for at in found.frequencies:
        assert at.snr is None and at.coherence_u is None and at.coherence_y is None
        assert at.relative_std is not None and at.relative_std < 0.02


def test_the_pumps_dead_zone_quantisation_and_rest_are_seen(shared_data: Path) -> None:
    found = inspect(read(shared_data / "real" / "eha_pump" / "exp_data_1_3.csv", columns=PUMP))
    assert found.dead_zone is not None and found.dead_zone.low < -112.0 and found.dead_zone.high > 112.0
    assert found.quantisation[2].step == 1.0
    assert found.rest is not None and found.rest.share == pytest.approx(0.6, abs=0.1)
    assert any('update_when = "moving"' in str(line) for line in found.recommendations)
    assert found.verdict == "usable with care"


def test_the_current_of_a_stepper_is_hardly_explained(shared_data: Path) -> None:
    columns = Columns(
        time="time",
        reference="set_point",
        input="current",
        output="set_point - position_error",
        segment=("load", "run", "group"),
    )
    found = inspect(read(shared_data / "real" / "cranfield" / "normal.csv", columns=columns, where={"load": "20"}))
    assert found.sampling.runs == 50
    assert "explained" in kinds(found, "care") | kinds(found, "stop")
    assert found.residual is not None and found.residual.period_s == pytest.approx(12.96)


def test_many_repetitions_of_the_reference_change_no_cutoff(rig: dict[str, Any]) -> None:
    """In ten minutes the lines of a period of 10 s lie far apart, and the band is that of one minute."""
    repeated = np.tile(reference("multisine", 60.0, 100.0), 10)
    found = inspect(simulate(Loop.from_dict(rig), repeated)[0])
    assert found.suggested_cutoff_hz == 10.0
    assert found.band is not None and found.band.low_hz < 0.1 and found.band.high_hz > 15.0


def test_a_long_recording_is_judged_by_stretches_of_it(rig: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    recording = recorded(rig, "multisine", 100.0)
    whole = inspect(recording, Loop.from_dict(rig))
    module = sys.modules[inspect.__module__]
    monkeypatch.setattr(module, "MAX_ROWS", 8000)
    monkeypatch.setattr(module, "MIN_STRETCH_ROWS", 3000)
    found = inspect(recording, Loop.from_dict(rig))
    assert found.sampling == whole.sampling and found.verdict == whole.verdict == "usable"
    assert [str(finding.message) for finding in found.findings if finding.kind == "long"] == [
        "8000 of 10000 rows were analysed, in evenly spread stretches"
    ]


def test_period_of_the_reference(rig: dict[str, Any]) -> None:
    loop = Loop.from_dict(rig)
    for kind in ("profile", "multisine", "trapezoid", "steps", "chirp"):
        assert reference_period(recorded(rig, kind, 35.0)) == 1000
    assert reference_period(recorded(rig, "profile", 15.0)) is None
    walk = np.cumsum(np.random.default_rng(0).normal(size=3000)) * 1e-4
    assert reference_period(simulate(loop, walk)[0]) is None


def test_an_inspection_is_json_and_comes_back(rig: dict[str, Any]) -> None:
    found = inspect(recorded(rig), Loop.from_dict(rig))
    text = json.dumps(found.model_dump(mode="json"), allow_nan=False)
    back = Inspection.model_validate_json(text)
    assert back.model_dump() == found.model_dump() and back.traces is None
    assert str(back.findings[0].message) and str(back.summary).endswith("usable")


def test_figures_and_the_page_hold_everything(rig: dict[str, Any], tmp_path: Path) -> None:
    recording = replace(recorded(rig), name="<b>&.csv")
    found = inspect(recording, Loop.from_dict(rig))
    titles = [title for title, _ in inspection_figures.plot_inspection(found, recording)]
    assert titles == ["Signals", "Spectra and coherence", "Residual"]
    inspection_page.write_inspection_page(tmp_path / "page.html", found, recording)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert text.count('<svg role="img"') == 3 and "&lt;b&gt;&amp;.csv" in text and "<b>&.csv" not in text
    assert "http" not in text.replace("http-equiv", "") and "<script" not in text
    assert text.index("Reasons") < text.index("<figure")
    with pytest.raises(OutputError):
        inspection_page.write_inspection_page(tmp_path / "none" / "page.html", found, recording)
