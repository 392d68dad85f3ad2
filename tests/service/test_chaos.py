"""The chaos benchmark itself, short: senders, broker and service are killed, cables are pulled, a clock jumps."""

from __future__ import annotations

import chaos
import pytest
from reliability.plc import SCRIPTS
from reliability.servers import mosquitto


@pytest.mark.slow
def test_nothing_is_lost_between_senders_and_the_store() -> None:
    if mosquitto() is None or not all(one.with_name("node_modules").is_dir() for one in SCRIPTS.values()):
        pytest.skip("Mosquitto, node-opcua or mqtt.js is missing: scripts/install-test-servers installs them")
    found = chaos.trial("sqlite", (3, 0.5, 40.0), block_s=30.0, every_s=3.0)
    assert found["blocks"] == 3 * 60
    assert {key: found[key] for key in ("lost", "doubled", "other", "misnumbered")} == dict.fromkeys(
        ("lost", "doubled", "other", "misnumbered"), 0
    )
    for others in (found[name] for name in chaos.SENDERS):
        assert others["stored"] and others["unnamed"] == others["other"] == 0
    assert not any(found["people"][key] for key in ("not counted", "without outcome", "rows set aside"))
    assert sum(map(len, found["happened"].values())) >= 3
    assert "0.5 h, 3 assets" in chaos.markdown([found])
