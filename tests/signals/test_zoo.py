"""A zoo of logs: each is read without an option, or with the one that its message names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from zoo import Exhibit, motion
from zoo_tables import ZOO

from servoscope.core.errors import RecordingError
from servoscope.learning.proposal import propose_columns, propose_loop
from servoscope.models.loop import Columns, TextLayout
from servoscope.signals.readers import list_channels, read

# asammdf and npTDMS warn of NumPy and pandas while they write
pytestmark = [pytest.mark.filterwarnings(f"ignore::{name}") for name in ("DeprecationWarning", "FutureWarning")]


def guessed(path: Path, text: TextLayout | None = None) -> Columns:
    """Return the columns as they are proposed for a file."""
    channels = list_channels(path, text)
    found = propose_columns(path, channels).model_copy(update={"text": text})
    assert found.reference != "r" or "r" in [channel.name for channel in channels], found
    return found


@pytest.mark.parametrize("one", [one for one in ZOO if not one.options], ids=lambda one: one.file)
def test_a_log_is_read_without_an_option(one: Exhibit, tmp_path: Path) -> None:
    path = tmp_path / one.file
    one.write(path)
    found = read(path, columns=guessed(path))
    expected = motion()
    assert found.samples == len(expected["t"]) and found.sample_rate == pytest.approx(100.0, rel=1e-6)
    np.testing.assert_allclose(found.t - found.t[0], expected["t"], atol=2e-6)
    for letter in "ruy":
        np.testing.assert_allclose(getattr(found, letter), expected[letter], rtol=1e-7, atol=1e-9, err_msg=letter)


def test_the_zoo_is_large_and_its_sources_are_named() -> None:
    without = [one for one in ZOO if not one.options]
    assert len(ZOO) >= 50 and len(without) >= 48
    assert sum("written by" in one.source for one in ZOO) >= 8
    assert len({one.file for one in ZOO}) == len(ZOO) and all(len(one.source) > 20 for one in ZOO)


@pytest.mark.parametrize("one", [one for one in ZOO if one.options], ids=lambda one: one.file)
def test_the_others_are_read_with_the_option_that_their_message_names(one: Exhibit, tmp_path: Path) -> None:
    path = tmp_path / one.file
    one.write(path)
    if "unit" in one.options:  # `init` asks whether the numbers of the clock are seconds
        lines = propose_loop([path], guessed(path)).lines
        assert ["--columns 't=" in str(line.why) for line in lines if line.doubtful and line.key == "time_unit"] == [
            True
        ]
        found = read(path, columns=guessed(path).model_copy(update={"time_unit": one.options["unit"]}))
        assert found.sample_rate == pytest.approx(100.0)
        return
    with pytest.raises(RecordingError) as caught:
        read(path)
    if "names" in one.options:
        assert "--columns 't=..., r=..., u=..., y=...'" in str(caught.value)
        found = read(path, columns=Columns(time="c0", reference="c1", input="c2", output="c3"))
    else:
        assert f"--{next(iter(one.options)).replace('_', '-')}" in str(caught.value)
        found = read(path, columns=guessed(path, TextLayout.model_validate(one.options)))
    np.testing.assert_allclose(found.y, motion()["y"], rtol=1e-7, atol=1e-9)
