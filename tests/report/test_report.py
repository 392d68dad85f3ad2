"""The report: what it says, that it needs nothing from outside, odd data, hostile names."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import screens
from pages import PROVENANCE, Reader, make_diagnosis, make_recording, make_trace, read

from servoscope.cli.output_paths import REPORTS, check_output
from servoscope.core.errors import OutputError
from servoscope.diagnosis.explanation import build_headline
from servoscope.diagnosis.motion_signature import compare_signatures
from servoscope.diagnosis.result import DiagnosisWarning, FinalCoefficient
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.models.loop import Loop
from servoscope.report import diagnosis_figures, plotting
from servoscope.report import diagnosis_page as report
from servoscope.signals import clean


@pytest.fixture
def loop(rig: dict[str, Any]) -> Loop:
    return Loop.from_dict(rig)


def test_a_fault_is_told_with_when_how_large_and_how_sure(loop: Loop) -> None:
    page = read(make_diagnosis(), loop)
    for words in (
        "internal leakage",
        "What the summary says.",
        "30.0 s",
        "95 %: 29.8 s to 30.2 s",
        "detected at 31.4 s",
        "+20.0 %",
        "95 %: +19.0 % to +21.0 %",
        "99.8 %",
        "Cie × 1.200",
        "1.190 to 1.210",
    ):
        assert words in page.text, words
    assert not page.wrong and not page.open


def test_the_page_is_one_well_formed_document_with_six_pictures(loop: Loop) -> None:
    page = read(make_diagnosis(), loop)
    pictures = [attrs for tag, attrs in page.tags if tag == "svg" and attrs.get("role") == "img"]
    ids = [attrs["id"] for _, attrs in page.tags if attrs.get("id")]
    assert len(pictures) == 6
    assert all("width" not in attrs and "height" not in attrs for attrs in pictures)
    assert len(ids) == len(set(ids)), "an id stands twice"
    used = {str(attrs["xlink:href"]).removeprefix("#") for tag, attrs in page.tags if tag == "use"}
    assert used and used <= set(ids), "a picture refers to a shape that is not there"


def test_nothing_comes_from_outside(loop: Loop) -> None:
    content = report.render_diagnosis_page(make_diagnosis(), make_trace(), make_recording(), loop, PROVENANCE)
    assert not re.search(r"(?i)https?:|//\w|@import|url\((?!#)|javascript:", content)
    page = Reader(content)
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "img", "object", "embed", "base"}
    for _, attrs in page.tags:
        for name in ("src", "href", "xlink:href"):
            assert (attrs.get(name) or "#").startswith("#")
        assert not [name for name in attrs if name.startswith("on")]


@pytest.mark.parametrize(
    ("verdict", "words"),
    [("healthy", "Healthy: no change found"), ("undetermined", "What the summary says.")],
)
def test_quiet_verdicts(loop: Loop, verdict: str, words: str) -> None:
    quiet = build_headline("healthy", (), {"C_ie": (0.036, 0.05)}, ()) if verdict == "healthy" else None
    page = read(make_diagnosis(verdict, **({"headline": quiet, "summary": str(quiet)} if quiet else {})), loop)
    assert words in page.text and "Largest statistic" in page.text
    assert ("changes of Cie by 3.6 % or more" in page.text) == (verdict == "healthy")
    assert "Since when" not in page.text and "What else" not in page.text and "What to check" not in page.text


AXIS: dict[str, Any] = {"sample_rate": 100.0, "plant": {"kind": "polynomial", "order": 2, "friction": "coulomb"}}


@pytest.mark.parametrize(("ratio", "words"), [(1.3, "More u for the same motion"), (0.8, "Less u for the same motion")])
def test_the_input_gain_is_told_in_words_and_once(ratio: float, words: str) -> None:
    gain = FaultEstimate(name="input_gain", parameter="input_gain", ratio=ratio, interval=(ratio - 0.01, ratio + 0.01))
    both = (
        Candidate(name="input_gain", probability=0.9996, faults=(gain,)),
        Candidate(name="inertia", probability=1e-4),
    )
    page = read(make_diagnosis(faults=(gain,), candidates=both, probability=0.9996), Loop.from_dict(AXIS))
    assert words.lower() in page.text and "on loop" not in page.text.lower()
    assert "input_gain" not in page.text.partition("Where this comes from")[0]
    assert ("More u for the same motion: weak motor, magnet or amplifier, or all" in page.text) == (ratio > 1.0)
    assert "> 99.9 % among the faults that this plant knows" in page.text
    assert f"input gain {words.lower()} > 99.9 % × {ratio}" in page.text
    assert "inertia inertia" not in page.text
    assert "by design at most once a year, if the noise stays as learned" in page.text


def test_what_is_no_percentage_has_a_unit(loop: Loop) -> None:
    assert loop.plant.coefficient_units == ("A/m", "A s/m", "A s²/m", "A s³/m")
    plant = {**AXIS["plant"], "friction": "directional", "offset": True}
    told = Loop.from_dict({**AXIS, "plant": plant}).plant.coefficient_units
    assert told == ("u s²/y", "u s/y", "u s/y", "u", "u")
    told = Loop.from_dict({**AXIS, "plant": {**plant, "input_gain": 35.15}}).plant.coefficient_units
    assert told[:1] == ("input_gain u s²/y",)  # newtons, where it is in N/V


def test_the_axes_give_way_to_a_path_but_not_to_a_wild_value() -> None:
    values = np.concatenate([np.linspace(0.0, 1.0, 200), [1.8]])
    assert plotting.robust_range(values)[1] < 1.2
    assert plotting.robust_range(values, room=2.5)[1] > 1.8
    assert plotting.robust_range(np.append(values, 50.0), room=2.5)[1] < 5.0


def test_an_open_question_is_told_as_one(loop: Loop) -> None:
    both = (Candidate(name="friction", probability=0.6), Candidate(name="contamination", probability=0.38))
    page = read(make_diagnosis(faults=(), candidates=both, probability=0.6), loop)
    assert "friction 60.0 %" in page.text and "contamination oil contamination 38.0 %" in page.text
    assert "for friction: too little to name it" in page.text
    unknown = (Candidate(name="unknown", probability=0.99), *both)
    page = read(make_diagnosis(faults=(), candidates=unknown, probability=0.99), loop)
    assert "A cause outside the list of faults (99.0 %): compare the machine" in page.text


def test_a_size_that_may_be_none_has_no_direction(loop: Loop) -> None:
    unsure = FaultEstimate(name="leakage", parameter="C_ie", ratio=0.99, interval=(0.9, 1.08))
    page = read(make_diagnosis(faults=(unsure,)), loop)
    assert "between −10 % and +8 %: the direction is not certain" in page.text and "−1 %" not in page.text


def test_numbers_warnings_settings_and_provenance_are_there(loop: Loop) -> None:
    page = read(make_diagnosis(), loop)
    for words in ("0.3129", "0.2590", "+20.8 %", "1.6625 ± 0.0020", "A/m"):
        assert words in page.text, words
    for words in ("gap of 37 rows, not bridged", "20.00 to 20.37", " 37 "):
        assert words in page.text, words
    for key, value in PROVENANCE.items():
        assert f"{key} {value}" in page.text
    for words in (
        "[plant]",
        "Cie 6 × 10⁻¹²",
        "[monitor]",
        "false_alarms_per_year 1",
        "frequencies 1, 10, 20",
    ):
        assert words in page.text, words


def test_hostile_names_stay_text(loop: Loop) -> None:
    evil = "<script>alert('x')</script>\"&$x$"
    fault = FaultEstimate(name=evil, parameter=evil, ratio=-1.5, interval=(-2.0, float("nan")))
    diagnosis = make_diagnosis(
        recording=evil + "\udc80",
        summary=evil,
        faults=(fault,),
        candidates=(Candidate(name=evil, probability=1.0, faults=(fault,)),),
        parameters={evil: FinalCoefficient(value=float("nan"), std=0.0, nominal=0.0)},
        warnings=(DiagnosisWarning(kind=evil, from_s=0.0, to_s=0.0, count=1, message=evil),),
    )
    loop = loop.model_copy(update={"name": evil})
    trace = make_trace(names=(evil, "a$b", "c_d", "$"))
    content = report.render_diagnosis_page(diagnosis, trace, make_recording(name=evil), loop, {evil: evil})
    page = Reader(content)
    assert not [tag for tag, _ in page.tags if tag == "script"] and "<script" not in content.lower()
    assert page.text.count("alert('x')") >= 8 and not page.wrong
    assert all(not name.startswith("on") for _, attrs in page.tags for name in attrs)


@pytest.mark.parametrize("verdict", ["fault", "healthy", "undetermined"])
@pytest.mark.parametrize("K", [0, 1, 2])
def test_short_traces_are_drawn(loop: Loop, K: int, verdict: str) -> None:
    page = read(make_diagnosis(verdict, ifrf=(), parameters={}), loop, make_trace(K), make_recording(20))
    assert not page.wrong
    assert ("the estimator never had enough data" in page.text) == (K == 0)


@pytest.mark.parametrize("F", [1, 2, 5, 8])
@pytest.mark.parametrize("n", [1, 3, 8])
def test_any_number_of_coefficients_and_frequencies_is_drawn(n: int, F: int) -> None:
    trace, diagnosis = make_trace(n=n, F=F), make_diagnosis()
    panels = len([ax for ax in diagnosis_figures.plot_ifrf(trace, diagnosis).axes if ax.axison])
    rows = len([ax for ax in diagnosis_figures.plot_coefficients(trace, diagnosis).axes if ax.axison])
    assert (panels, rows) == (F, n)
    assert "8 Hz" in plotting.render_svg(diagnosis_figures.plot_ifrf(trace), "x") or F < 8


@pytest.mark.parametrize("unready", ["ready", "theta", "expected", "covariance", "some"])
def test_what_is_not_a_number_does_not_stop_a_picture(unready: str) -> None:
    trace = make_trace()
    if unready == "ready":
        trace = dataclasses.replace(trace, ready=np.zeros(600, dtype=bool))
    elif unready == "some":
        theta, value = trace.theta.copy(), trace.statistic.copy()
        theta[100:200], value[100:200], value[0] = np.nan, np.nan, 0.0
        trace = dataclasses.replace(trace, theta=theta, statistic=value)
    else:
        nan = np.full_like(getattr(trace, unready), np.nan)
        H = np.full_like(trace.ifrf.H, np.nan)
        broken = dataclasses.replace(trace.ifrf, H=H, covariance=np.full_like(trace.ifrf.covariance, np.nan))
        trace = dataclasses.replace(trace, **{unready: nan}, ifrf=broken, ifrf_expected=broken)
    for draw in (diagnosis_figures.plot_statistic, diagnosis_figures.plot_coefficients, diagnosis_figures.plot_ifrf):
        assert "<svg" in plotting.render_svg(draw(trace, make_diagnosis()), "x")


def test_a_coefficient_that_should_be_zero_is_drawn_in_its_own_units() -> None:
    trace = make_trace()
    expected = trace.expected.copy()
    expected[:, 1] = 0.0
    axes = diagnosis_figures.plot_coefficients(dataclasses.replace(trace, expected=expected)).axes
    assert [ax.get_ylabel() for ax in axes] == [
        "deviation [%]",
        "deviation",
        "deviation [%]",
        "deviation [%]",
    ]


def test_pages_of_long_recordings_are_small(loop: Loop, tmp_path: Path) -> None:
    recording, trace, diagnosis = make_recording(1_000_000), make_trace(100_000), make_diagnosis()
    report.write_diagnosis_page(tmp_path / "long.html", diagnosis, trace, recording, loop, PROVENANCE)
    assert (tmp_path / "long.html").stat().st_size < 3_000_000


def test_the_envelope_keeps_every_peak_and_every_gap() -> None:
    rng = np.random.default_rng(3)
    t, x = np.arange(100_000) / 100.0, rng.normal(size=100_000)
    x[54_321] = 99.0
    restart = np.zeros(len(t), dtype=bool)
    restart[[0, 30_000]] = True
    t[30_000:] += 50.0
    x[70_000:72_000] = np.nan
    at, value = plotting.envelope(t, x, restart)
    assert len(at) == len(value) <= 3 * 1200 + 1
    assert np.nanmax(value) == 99.0 and np.nanmin(value) == np.nanmin(x)
    assert np.isnan(value[(at >= 350.0) & (at < 350.5)]).any() and np.isnan(value[(at > 752.0) & (at < 768.0)]).all()
    assert (np.diff(at) >= 0.0).all()
    short = plotting.envelope(t[:5], x[:5], np.array([True, False, True, False, False]))[1]
    np.testing.assert_array_equal(short, [x[0], x[1], np.nan, x[2], x[3], x[4]])


def test_many_gaps_are_joined_where_they_cannot_be_told_apart() -> None:
    t = np.linspace(0.0, 1000.0, 100_001)
    low = np.arange(0.0, 900.0, 0.1)
    assert len(plotting.visible_spans(t, low, low + 0.05)) == 1
    assert len(plotting.visible_spans(t, low[:40], low[:40] + 0.05)) == 40
    assert plotting.visible_spans(t, low[:0], low[:0]) == []


def test_the_same_diagnosis_gives_the_same_page(loop: Loop) -> None:
    pages = {
        report.render_diagnosis_page(make_diagnosis(), make_trace(), make_recording(), loop, PROVENANCE)
        for _ in range(2)
    }
    assert len(pages) == 1


def test_pictures_do_not_change_the_users_matplotlib() -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    plotting.render_svg(diagnosis_figures.plot_statistic(make_trace()), "x")
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_a_picture_is_saved(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"x.{ending}"
    plotting.save_figure(diagnosis_figures.plot_signals(make_recording(), make_diagnosis(), units=("m", "A")), path)
    assert path.read_bytes()[:5] in (b"<?xml", b"\x89PNG\r", b"%PDF-")
    with pytest.raises(OutputError, match=r"x\.bmp: a figure is written as"):
        plotting.save_figure(diagnosis_figures.plot_statistic(make_trace()), tmp_path / "x.bmp")


def test_writing_is_all_or_nothing(loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.html"
    path.write_text("before")
    path.chmod(0o640)

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_disk)
        with pytest.raises(OutputError) as caught:
            report.write_diagnosis_page(path, make_diagnosis(), make_trace(), make_recording(), loop, PROVENANCE)
    assert str(caught.value) == f"{path}: cannot be written (No space left on device)"
    assert path.read_text() == "before" and [each.name for each in tmp_path.iterdir()] == ["r.html"]
    report.write_diagnosis_page(path, make_diagnosis(), make_trace(), make_recording(), loop, PROVENANCE)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert path.stat().st_mode & 0o777 == 0o640 and len(list(tmp_path.iterdir())) == 1


def test_the_first_page_says_what_to_check(loop: Loop) -> None:
    text = read(make_diagnosis(checks=("piston seal and valve edges",)), loop).text
    assert "Piston seal and valve edges" in text
    order = ("What the summary says.", "What to check", "Since when", "What else", "For experts", "Settings")
    assert [text.index(words) for words in order] == sorted(text.index(words) for words in order)
    assert "What to check" not in read(make_diagnosis("healthy"), loop).text


def test_a_report_is_printed_on_two_sheets(loop: Loop, tmp_path: Path) -> None:
    if screens.browser() is None:
        pytest.skip("there is no Chromium: scripts/install-test-servers installs it")
    path = tmp_path / "report.pdf"
    report.write_diagnosis_page(path, make_diagnosis(), make_trace(), make_recording(), loop, PROVENANCE)
    assert re.findall(rb"/Type /Pages\s/Count (\d+)", path.read_bytes()) == [b"2"]


def test_without_a_browser_a_pdf_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OutputError, match=r"a PDF needs Chromium, Chrome or Edge on this machine; write r\.html"):
        check_output(tmp_path / "r.pdf", "--report", REPORTS, [])


def test_the_motion_signature_shows_dry_friction_before_and_after() -> None:
    """A mass of 2 that takes 0.4 of u to slide forward or backward, 0.7 from the middle on: bands of 0.8 and 1.4."""
    t = np.arange(0.0, 60.0, 0.005)
    w = 2.0 * np.pi * np.array([0.23, 0.71])[:, None]
    y = (np.array([[0.05], [0.02]]) * np.sin(w * t)).sum(axis=0)
    v, a = np.gradient(y, t), np.gradient(np.gradient(y, t), t)
    friction = np.where(t < 30.0, 0.4, 0.7) * np.sign(v)
    noise = 0.02 * np.random.default_rng(1).standard_normal(t.size)
    recording = clean(t, y + 1e-3 * np.sign(v), 2.0 * a + 3.0 * v + friction + noise, y)
    plant = {"kind": "polynomial", "order": 2, "friction": "coulomb"}
    loop = Loop.from_dict({"sample_rate": 200.0, "plant": plant, "monitor": {"cutoff": 10.0}})
    before, after = compare_signatures(recording, loop, 30.0)
    assert before is not None and after is not None
    for signature, band in ((before, 0.8), (after, 1.4)):
        assert signature.friction_band.value == pytest.approx(band, abs=0.03)
        assert signature.lost_motion is not None and signature.lost_motion.value == pytest.approx(2e-3, rel=0.05)
        between = np.nanmedian(signature.forward - signature.backward)
        assert between > band  # at speed, viscous friction comes on top
    assert compare_signatures(recording, loop, None)[0] is None
    assert compare_signatures(recording[:60], loop, None)[1] is None  # one way only
