"""OPC UA against a stack that nobody here wrote (node-opcua): what it grants is less than it was asked for."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from brokers import until
from oidc_provider import found_node
from test_opcua import certificate, free_port, source_assets

from servoscope.core.errors import ConfigError
from servoscope.service.opcua.settings import OpcuaNodes, describe_expiry
from servoscope.service.opcua.source import OpcuaSourceSettings
from servoscope.service.opcua.subscriptions import ItemTerms, ScalarSubscription
from servoscope.service.sources.assembly import STEPS, UpdateRate
from servoscope.service.sources.block import Block, ResumePosition
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import RejectionCounter
from servoscope.service.sources.resample import Resampler

SERVER = Path(__file__).parents[1] / "support" / "opcua_server" / "plant.js"
RATE = 20.0
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def nodes(machine: str, y: str = "y") -> OpcuaNodes:
    return OpcuaNodes(r=f"ns=1;s={machine}.r", u=f"ns=1;s={machine}.u", y=f"ns=1;s={machine}.{y}")


class ForeignPlant:
    """The server of `opcua_server`, which may be killed and started again."""

    def __init__(self) -> None:
        self.port, self._node = free_port(), found_node(SERVER)
        self.start()

    def start(self) -> None:
        words = [self._node, str(SERVER), str(self.port), str(RATE)]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._process.stdout is not None
        until(lambda: self._process.stdout and "ready" in self._process.stdout.readline(), 120.0)
        self._process.stdout.close()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def source(self, **assets: tuple[OpcuaNodes, float]) -> Inbox:
        settings = OpcuaSourceSettings.model_validate(
            {"kind": "opcua", "url": f"opc.tcp://127.0.0.1:{self.port}/plant", "block": 0.5}
        )
        told = {name: source_assets(*one)["press"] for name, one in assets.items()}
        return settings.create("hall.line", told, Path())


@pytest.fixture(scope="module")
def plant() -> Iterator[ForeignPlant]:
    one = ForeignPlant()
    yield one
    one.kill()


def test_what_comes_too_slowly_is_told_and_makes_no_samples(plant: ForeignPlant) -> None:
    """The server makes 50 ms of the 10 that are asked for; 0.9 of the samples would be a value held too long."""
    source = plant.source(press=(nodes("press"), 100.0), lift=(nodes("lift"), RATE), wrong=(nodes("lift", "z"), RATE))
    source.open({})
    blocks: list[Block] = []
    until(lambda: (blocks.extend(source.poll(100)), len(blocks) > 3)[1], 60.0)
    assert source.connected and not source.trouble
    assert {block.asset for block in blocks} == {"lift"}  # one slow and one mistyped asset cost no other
    press = source.asset_troubles["press"]
    assert press.state == "slow" and "u comes every 50 ms, the loop needs 10" in press.why
    wrong = source.asset_troubles["wrong"]
    assert wrong.state == "refused" and "ns=1;s=lift.z (BadNodeIdUnknown)" in wrong.why
    until(lambda: ("lift", "u") in source.update_intervals_s, 60.0)
    assert source.update_intervals_s["lift", "u"] == pytest.approx(1.0 / RATE, rel=0.3)
    y = np.concatenate([block.y for block in blocks])
    assert np.abs(y - 5.0).min() > 1.0 and np.ptp(y) > 1.0  # a cosine, and no held value
    plant.kill()
    until(lambda: not source.connected and source.trouble, 60.0)
    plant.start()
    until(lambda: source.connected, 60.0)
    seen = len(blocks)
    until(lambda: (blocks.extend(source.poll(100)), len(blocks) > seen)[1], 60.0)
    source.close()


def subscription(**grants: ItemTerms) -> tuple[ScalarSubscription, list[Block], float]:
    """Return r, u and y at 100 Hz with what a server grants of them, and the longest publishing interval for that."""
    made: list[Block] = []
    one = ScalarSubscription("press", list(grants), ResumePosition(-1, 0.0), made.append, RejectionCounter(), 100.0, 50)
    one.check_grants(grants, 0.2)
    return one, made, one.longest_interval_s(grants)


def test_short_queues_ask_for_sooner_messages_and_else_are_told() -> None:
    granted = ItemTerms(10.0, 40)
    assert subscription(r=granted, u=granted, y=granted)[0].trouble is None
    short, _, longest = subscription(r=granted, u=ItemTerms(10.0, 8), y=granted)
    assert longest == pytest.approx(0.08)
    assert short.trouble is not None and "the server keeps 8 values of u" in short.trouble.why
    short.check_grants({"r": granted, "u": ItemTerms(10.0, 8), "y": granted}, 0.04)  # the server has agreed to that
    assert short.trouble is None


def test_a_rate_is_what_comes_and_not_what_a_server_says() -> None:
    t = np.arange(STEPS + 1.0)
    rng = np.random.default_rng(1)
    for period, values, slow in (
        (0.05, np.sin(t / 5.0), True),  # five samples long
        (0.05, np.floor(t / 2.0), False),  # a coarse sensor that creeps: one step at a time
        (0.011, np.sin(t / 5.0), False),
    ):
        rate = UpdateRate()
        for k, value in enumerate(values):
            rate.add(period * k + rng.uniform(-0.001, 0.001), float(value))
        assert rate.is_too_slow(0.01) is slow
        assert rate.interval_s == pytest.approx(period, rel=0.2)
    one = UpdateRate()
    assert one.contradicts(0.2) is None
    for k in range(20):
        one.add(0.01 * k, float(k))
    assert one.contradicts(0.2) is True and one.contradicts(0.01) is False


def test_a_hole_in_a_history_is_a_gap_and_no_machine_that_stood_still() -> None:
    def resampled(history_until: float) -> tuple[int, list[int]]:
        one = Resampler(2, 0.1, 1000.0)
        one.restart(1000.0, complete=True, history_until=history_until)
        one.add(0, 999.0, 5.0)  # holds since then
        for t in (*np.arange(1000.1, 1002.0, 0.1), *np.arange(1032.0, 1034.0, 0.1)):
            one.add(1, float(t), float(t))
        found = one.take_samples(-math.inf)
        assert (found.values[0] == 5.0).all()
        return int((np.abs(found.values[1] - found.t) > 0.05).sum()), [gap.samples for gap in found.gaps]

    held, gaps = resampled(1034.0)
    assert held == 0 and len(gaps) == 1 and gaps[0] == pytest.approx(300, abs=2)
    held, gaps = resampled(-math.inf)  # told as it happened, under a heartbeat: the machine did stand still
    assert held == pytest.approx(300, abs=2) and not gaps


def test_a_certificate_that_has_expired_is_told_while_samples_go_on(tmp_path: Path) -> None:
    ours = certificate(tmp_path, "client", "urn:servoscope:client")
    theirs = certificate(tmp_path, "server", "urn:servoscope")
    settings = OpcuaSourceSettings.model_validate({"kind": "opcua", "url": "opc.tcp://plc", **ours})

    def told(peer: bytes | None, now: datetime) -> str:
        client = SimpleNamespace(security_policy=SimpleNamespace(peer_certificate=peer))
        return describe_expiry(client, tmp_path, settings, now)

    peer, now = (tmp_path / theirs["cert_file"]).read_bytes(), datetime.now(UTC)
    assert told(peer, now) == told(None, now) == ""
    later = told(peer, now + timedelta(days=3))  # they hold for two
    assert "our certificate expired on 20" in later and "the server's certificate expired on 20" in later


def test_a_node_that_cannot_be_one_is_refused_before_anything_starts() -> None:
    settings = OpcuaSourceSettings.model_validate({"kind": "opcua", "url": "opc.tcp://plc"})
    with pytest.raises(ConfigError, match=r"'press\.y' is no node id, write for example ns=2;s=press.y"):
        settings.create("hall.line", source_assets(OpcuaNodes(block="press.y"), RATE), Path())
