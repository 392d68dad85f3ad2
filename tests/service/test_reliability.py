"""The reliability benchmark itself, short: a fleet disturbed by kills and a store that is gone for a while."""

from __future__ import annotations

import pytest
import soak
from reliability.servers import programs


@pytest.mark.slow
@pytest.mark.parametrize("name", soak.TRIALS)
def test_nothing_is_lost_and_nothing_counts_twice(name: str) -> None:
    if name == "postgresql" and programs() is None:
        pytest.skip("PostgreSQL is not on this machine: scripts/install-test-servers installs it")
    found = soak.trial(name, (6, 0.5, 120.0), every_s=4.0)
    assert found["blocks"] == 6 * 60
    wrong = ("lost", "duplicated", "other", "misnumbered", "different")
    assert {key: found[key] for key in wrong} == dict.fromkeys(wrong, 0)
    assert found["lives"] > 1 and found["compared"] == 6
    assert "simulated | 0.5 h, 6 assets" in soak.markdown([found])
