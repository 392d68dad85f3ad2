"""A zoo of logs: each is read without an option, or with the one that its message names."""

from __future__ import annotations

from pathlib import Path

import pytest
from zoo import Exhibit
from zoo_outcomes import Outcome, find_outcome
from zoo_tables import ZOO

# asammdf and npTDMS warn of NumPy and pandas while they write
pytestmark = [pytest.mark.filterwarnings(f"ignore::{name}") for name in ("DeprecationWarning", "FutureWarning")]


@pytest.mark.parametrize("one", ZOO, ids=lambda one: one.file)
def test_a_log_is_read_at_once_or_with_the_option_that_its_message_names(one: Exhibit, tmp_path: Path) -> None:
    assert find_outcome(one, tmp_path / one.file) is (Outcome.ONE_LINE if one.options else Outcome.AT_ONCE)


def test_the_zoo_is_large_and_its_sources_are_named() -> None:
    assert len(ZOO) >= 50 and sum(not one.options for one in ZOO) >= 48
    assert sum("written by" in one.source for one in ZOO) >= 10
    assert len({one.file for one in ZOO}) == len(ZOO) and all(len(one.source) > 20 for one in ZOO)
