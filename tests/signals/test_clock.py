"""The time axis of a log: swapped rows, resets, jitter, rates, and clocks that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest
from dirty import cleaned, only, refusal, signals


def test_a_repeated_stamp_is_dropped() -> None:
    data = {key: np.insert(x, 301, x[300]) for key, x in signals().items()}
    recording = cleaned(data)
    defect = only(recording, "repeat")
    assert (defect.from_s, defect.count) == (3.0, 1)
    np.testing.assert_array_equal(recording.y, signals()["y"])


def test_of_a_repeated_stamp_the_row_that_is_usable_stays() -> None:
    data = {key: np.insert(x, 301, x[300]) for key, x in signals().items()}
    data["y"][300] = np.nan
    recording = cleaned(data)
    assert [d.kind for d in recording.defects] == ["nan"]
    assert recording.samples == 2000


def test_swapped_rows_are_sorted_and_start_no_run() -> None:
    data = signals()
    order = np.arange(2000)
    order[[800, 801]] = [801, 800]
    recording = cleaned({key: x[order] for key, x in data.items()})
    assert only(recording, "order").count == 2
    np.testing.assert_array_equal(recording.y, data["y"])
    assert recording.restart.sum() == 1


def test_a_row_that_arrives_seconds_late_is_sorted() -> None:
    data = signals()
    order = np.insert(np.delete(np.arange(2000), 800), 1200, 800)
    recording = cleaned({key: x[order] for key, x in data.items()})
    np.testing.assert_array_equal(recording.y, data["y"])
    assert recording.run.max() == 0


def test_swapped_rows_at_the_very_end_are_sorted() -> None:
    data = signals()
    order = np.arange(2000)
    order[-2:] = [1999, 1998]
    assert only(cleaned({key: x[order] for key, x in data.items()}), "order").to_s == pytest.approx(19.99)


def test_a_time_reset_starts_a_run_laid_after_the_one_before() -> None:
    data = signals()
    data["t"] = data["t"] % 5.0
    recording = cleaned(data)
    assert recording.defects == ()
    np.testing.assert_allclose(recording.t, signals()["t"], atol=1e-9)
    np.testing.assert_allclose(recording.t[recording.restart], [0.0, 5.0, 10.0, 15.0], atol=1e-9)
    assert np.bincount(recording.run).tolist() == [500] * 4


def test_a_run_without_a_usable_row_is_not_counted() -> None:
    data = signals()
    data["y"][500:1000] = np.nan
    recording = cleaned(data, run=np.arange(2000) // 500)
    assert np.bincount(recording.run).tolist() == [500] * 3
    assert np.flatnonzero(recording.restart).tolist() == [0, 500, 1000]


def test_nothing_is_sorted_across_runs() -> None:
    data = signals()
    data["t"] = data["t"] % 5.0
    np.testing.assert_array_equal(cleaned(data).y, data["y"])


def test_marks_start_runs_and_time_that_goes_on_stays() -> None:
    data = signals()
    recording = cleaned(data, run=(data["t"] >= 10.0).astype(int))
    np.testing.assert_array_equal(recording.t, data["t"])
    assert recording.t[recording.restart].tolist() == [0.0, 10.0]
    assert recording.run[[0, -1]].tolist() == [0, 1]


def test_a_swap_inside_a_later_run_is_told_on_the_recordings_clock() -> None:
    data = signals()
    data["t"] = data["t"] % 10.0
    order = np.arange(2000)
    order[[1500, 1501]] = [1501, 1500]
    recording = cleaned({key: x[order] for key, x in data.items()})
    assert only(recording, "order").from_s == pytest.approx(15.0)


def test_one_absurd_stamp_is_dropped() -> None:
    data = signals()
    data["t"][600] = 1e6
    recording = cleaned(data)
    assert [d.kind for d in recording.defects] == ["clock", "gap"]
    assert recording.t[-1] == pytest.approx(19.99)


def test_a_missing_stamp_drops_the_row() -> None:
    data = signals()
    data["t"][600] = np.nan
    assert sorted(d.kind for d in cleaned(data).defects) == ["gap", "nan"]


def test_jitter_is_counted_and_kept() -> None:
    data = signals()
    data["t"] = data["t"] + np.random.default_rng(1).uniform(-0.002, 0.002, 2000)
    recording = cleaned(data)
    defect = only(recording, "jitter")
    assert defect.count > 500
    assert recording.samples == 2000
    assert recording.restart.sum() == 1


def test_stamps_rounded_to_milliseconds_do_not_change_the_rate() -> None:
    data = signals()
    data["t"] = np.round(np.arange(2000) / 300.0, 3)
    recording = cleaned(data, sample_rate=300.0)
    assert recording.restart.sum() == 1
    assert cleaned(data, sample_rate=None).sample_rate == pytest.approx(300.0, rel=1e-3)


def test_the_rate_is_measured_where_none_is_expected() -> None:
    assert cleaned(signals(), sample_rate=None).sample_rate == 100.0


def test_a_slightly_wrong_rate_is_told() -> None:
    data = signals()
    data["t"] = data["t"] * 1.005
    defect = only(cleaned(data), "clock")
    assert "99.5025 Hz" in defect.message
    assert "100 Hz" in defect.message


def test_a_wrong_rate_is_refused_with_both() -> None:
    data = signals()
    data["t"] = data["t"] * 1.02
    text = refusal(data)
    assert "98.0392 Hz" in text
    assert "100 Hz" in text


def test_a_time_in_milliseconds_is_guessed_aloud() -> None:
    data = signals()
    data["t"] = data["t"] * 1e3
    assert 'time_unit = "ms"' in refusal(data)


def test_time_that_runs_backwards_is_refused() -> None:
    data = signals()
    data["t"] = data["t"][::-1].copy()
    assert "backwards throughout" in refusal(data)


def test_shuffled_rows_are_refused() -> None:
    data = signals()
    data["t"] = np.random.default_rng(0).permutation(data["t"])
    assert "go backwards" in refusal(data)


def test_a_clock_that_is_too_coarse_is_refused() -> None:
    data = signals()
    data["t"] = np.floor(data["t"])
    assert "too coarse" in refusal(data)


def test_a_clock_that_stands_is_refused() -> None:
    assert "too coarse" in refusal(signals() | {"t": np.zeros(2000)})


def test_a_time_column_without_numbers_is_refused() -> None:
    assert "time column holds no numbers" in refusal(signals() | {"t": np.full(2000, np.nan)})


def test_irregular_sampling_is_refused() -> None:
    data = signals()
    data["t"] = np.cumsum(np.random.default_rng(0).exponential(0.01, 2000))
    assert "far from one sample" in refusal(data, sample_rate=None)


@pytest.mark.parametrize("sample_rate", [None, 1.0 / 0.065])
def test_as_many_short_steps_as_long_ones_are_refused(sample_rate: float | None) -> None:
    data = signals(201)
    data["t"] = np.cumsum([0.0, *[0.03, 0.1] * 100])
    assert "far from one sample" in refusal(data, sample_rate=sample_rate)


def test_a_plateau_of_u_is_told_where_no_limits_are_known() -> None:
    data = signals()
    data["u"] = np.clip(data["u"], -0.1, 0.1)
    recording = cleaned(data)
    assert {defect.kind for defect in recording.defects} == {"saturation"}
    assert "perhaps" in recording.defects[0].message
