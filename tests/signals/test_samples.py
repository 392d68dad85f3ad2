"""The record of samples: rows, stretches put together, recordings as samples."""

from __future__ import annotations

import numpy as np
import pytest

from servoscope.core.errors import RecordingError
from servoscope.signals import Recording, Samples


def samples(n: int = 6) -> Samples:
    t = np.arange(n) / 10
    return Samples.from_columns(t, t + 1, t + 2, t + 3, channels={"temperature": 20 + t})


def test_rows_and_stretches_put_together_are_the_samples_again() -> None:
    whole = samples()
    parts = [whole[:2], whole[np.array([2, 3])], whole[whole.t >= 0.4]]
    again = Samples.concatenate(parts)
    assert [len(part) for part in parts] == [2, 2, 2]
    for column, expected in zip(again.columns, whole.columns, strict=True):
        assert np.array_equal(column, expected)
    assert np.array_equal(again.channels["temperature"], whole.channels["temperature"])
    assert parts[0].u.base is whole.u, "a slice copies nothing"
    assert len(Samples.concatenate([])) == 0


def test_columns_of_different_lengths_are_an_error() -> None:
    with pytest.raises(RecordingError, match="equal length"):
        Samples.from_columns([0, 1], [0, 1], [0], [0, 1])
    with pytest.raises(RecordingError, match="equal length"):
        Samples.from_columns([0, 1], [0, 1], [0, 1], [0, 1], channels={"x": [1]})


def test_a_recording_is_samples_with_a_name_and_a_rate() -> None:
    few = samples()
    recording = Recording(*few.columns, name="axis", sample_rate=10.0, run=np.zeros(len(few), np.int32))
    assert isinstance(recording, Samples)
    part = recording[2:4]
    assert (part.name, part.sample_rate, part.samples) == ("axis", 10.0, 2)
    assert part.u.base is few.u
