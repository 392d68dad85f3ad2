"""A zoo of logs: each is read without an option, or with the one that its message names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zoo import ZOO, Exhibit, motion

from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns, TextLayout
from servoscope.signals.readers import list_channels, read
from servoscope.signals.readers.guess_columns import guess_mapping

# asammdf and npTDMS warn of NumPy and pandas while they write
pytestmark = [pytest.mark.filterwarnings(f"ignore::{name}") for name in ("DeprecationWarning", "FutureWarning")]


def guessed(path: Path, text: TextLayout | None = None) -> Columns:
    """Return the columns as they are proposed for a file."""
    fields: dict[str, Any] = guess_mapping([channel.name for channel in list_channels(path, text)])
    assert fields["reference"] and fields["input"] and fields["output"], fields
    return Columns.model_validate({**fields, "segment": (), "text": text})


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
    assert len(ZOO) >= 30 and len(without) >= 28
    assert len({one.file for one in ZOO}) == len(ZOO) and all(len(one.source) > 20 for one in ZOO)


@pytest.mark.parametrize("one", [one for one in ZOO if one.options], ids=lambda one: one.file)
def test_the_others_are_read_with_the_option_that_their_message_names(one: Exhibit, tmp_path: Path) -> None:
    path = tmp_path / one.file
    one.write(path)
    with pytest.raises(RecordingError) as caught:
        read(path)
    if "names" in one.options:
        assert "--columns 't=..., r=..., u=..., y=...'" in str(caught.value)
        found = read(path, columns=Columns(time="c0", reference="c1", input="c2", output="c3"))
    else:
        assert f"--{next(iter(one.options)).replace('_', '-')}" in str(caught.value)
        found = read(path, columns=guessed(path, TextLayout.model_validate(one.options)))
    np.testing.assert_allclose(found.y, motion()["y"], rtol=1e-7, atol=1e-9)
