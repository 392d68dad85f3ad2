"""The chaos benchmark itself, short: publisher, broker, OPC UA server and service are killed, cables are pulled."""

from __future__ import annotations

import pytest
from reliability import chaos
from reliability.servers import mosquitto


@pytest.mark.slow
def test_nothing_is_lost_between_senders_and_the_store() -> None:
    if mosquitto() is None:
        pytest.skip("Mosquitto is not on this machine: scripts/install-test-servers installs it")
    found = chaos.trial(hours=0.5, assets=3, speed=40.0, every_s=3.0)
    assert found["blocks"] == 3 * 60
    assert {key: found[key] for key in ("lost", "doubled", "other", "misnumbered")} == dict.fromkeys(
        ("lost", "doubled", "other", "misnumbered"), 0
    )
    for others in (found["plain"], found["plc"]):
        assert others["stored"] and others["unnamed"] == others["other"] == 0
    assert sum(map(len, found["happened"].values())) >= 3
    assert "0.5 h, 3 assets" in chaos.markdown(found)
