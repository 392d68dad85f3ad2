"""Spikes: found where they are, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest
from dirty import RATE, cleaned, only, signals

from servoscope.signals.spikes import find_spikes, follows_reference_step


@pytest.mark.parametrize("channel", "ruy")
@pytest.mark.parametrize("size", [9999.0, -9999.0, 0.5])
def test_a_spike_is_dropped(channel: str, size: float) -> None:
    data = signals()
    data[channel][1037] += size * (1.0 if abs(size) > 1.0 else 4.0 * float(np.ptp(data[channel])))
    recording = cleaned(data)
    defect = only(recording, "spike")
    assert (defect.from_s, defect.count) == (10.37, 1)
    assert channel in defect.message
    assert recording.t[recording.restart].tolist() == [0.0, 10.38]


@pytest.mark.parametrize("width", [2, 3, 10])
def test_a_wide_spike_is_dropped(width: int) -> None:
    data = signals()
    data["y"][1037 : 1037 + width] = 9999.0
    assert only(cleaned(data), "spike").count == width


@pytest.mark.parametrize("row", [0, 1999])
def test_a_spike_at_either_end_is_dropped(row: int) -> None:
    data = signals()
    data["y"][row] = 9999.0
    assert only(cleaned(data), "spike").count == 1


def test_several_spikes_do_not_hide_each_other_nor_what_is_between() -> None:
    data = signals()
    rows = [1000, 1003, 1011, 1012, 1500]
    data["y"][rows] = [9999.0, -9999.0, 9999.0, 30.0, 1.0]
    recording = cleaned(data)
    lost = sorted(set(range(2000)) - set(np.round(recording.t * RATE).astype(int)))
    assert lost == rows


def test_the_kick_of_u_at_a_step_of_r_is_no_spike_up_to_ten_times_its_range() -> None:
    data = signals()
    assert follows_reference_step(data["r"], np.zeros(2000, dtype=np.int32), np.array([200, 400])).all()
    data["u"][[200, 400]] += 2.0 * float(np.ptp(data["u"]))
    assert cleaned(data).defects == ()


def test_counts_of_an_encoder_at_rest_are_no_spikes() -> None:
    y = np.zeros(2000)
    y[1000:] = 2.0
    y[::37] += 1.0
    assert not find_spikes(y, np.zeros(2000, dtype=np.int32), share=0.1).size


def test_spikes_are_not_looked_for_across_runs() -> None:
    x = 0.2 * np.sin(0.01 * np.arange(2002))
    x[1000:1002] = 1.0
    run = np.zeros(2002, dtype=np.int32)
    assert find_spikes(x, run, share=0.1).tolist() == [1000, 1001]
    run[1001:] = 1
    assert not find_spikes(x, run, share=0.1).size
