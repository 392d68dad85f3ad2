"""What a service does not hear: clients of one name, senders with a wrong clock, assets that never come: all told."""

from __future__ import annotations

import json
import math
import re
import signal
import time
import tomllib
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import halls
import numpy as np
import pytest
from brokers import Running, Sender, started_broker, until
from halls import asked
from inboxes import STUB
from reliability.servers import Mosquitto
from typer.testing import CliRunner

from servoscope.cli.app import app
from servoscope.cli.render.history import active_alarms
from servoscope.core.errors import ConfigError
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.actions import ActionSettings
from servoscope.service.alarms import AlarmSettings
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.reception import Reception, ReceptionLog
from servoscope.service.build import build_components
from servoscope.service.config import DiagnosisSettings, ServiceFile
from servoscope.service.health import serve_health
from servoscope.service.mqtt import client
from servoscope.service.mqtt.source import MqttSourceSettings
from servoscope.service.notifications import Notifier
from servoscope.service.service import Service
from servoscope.service.sources.block import Block
from servoscope.signals.quality import QualitySettings

DOCS = Path(__file__).parents[2] / "docs" / "how-to"
NOW = 1795000000.0
DAY = 86400.0


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    server = started_broker(tmp_path)
    yield server
    server.stop(signal.SIGKILL)


def block(k: int, *, ahead_s: float = 0.0, sequence: int | None = None, began: float = NOW) -> Block:
    """Return half a second of the asset press; its sender's clock is ahead by so much."""
    rate = halls.baseline().loop.sample_rate
    t = began + ahead_s + (0.5 * rate * k + np.arange(round(0.5 * rate))) / rate
    return Block("press", k if sequence is None else sequence, t, *np.random.default_rng(k).normal(size=(3, t.size)))


def asset() -> Asset:
    policy = AssetPolicy(DiagnosisSettings(), QualitySettings(), AlarmSettings(), 60.0)
    return Asset("press", halls.baseline(), Monitor(halls.baseline()), policy)


def take(one: Asset, *blocks: Block, clock: float = NOW + 60.0) -> list[str]:
    return ["" if (refusal := one.process(each, clock).refusal) is None else refusal.kind for each in blocks]


@pytest.mark.parametrize("ahead_s", [7200.0, 95.0 * 365.0 * DAY])
@pytest.mark.parametrize("restarts", [False, True])
def test_a_sender_whose_clock_is_ahead_for_a_while_costs_these_blocks_only(ahead_s: float, restarts: bool) -> None:
    one = asset()
    assert take(one, *(block(k) for k in range(4))) == [""] * 4
    assert take(one, *(block(k, ahead_s=ahead_s) for k in range(4, 9))) == ["future"] * 5
    after = (block(k, sequence=k - 9 if restarts else k) for k in range(9, 12))  # it may have been started again
    assert take(one, *after) == [""] * 3
    assert one.state is not None
    position = one.state.position
    assert (position.blocks, position.future, position.late, position.repeated, position.lost) == (7, 5, 0, 0, 0)
    assert position.t == block(11).t[-1]
    assert all(alarm.since <= NOW + 60.0 for alarm in one.state.alarms.values())  # none is dated to the future


def test_late_repeated_and_future_blocks_are_counted_apart() -> None:
    one = asset()
    take(one, *(block(k) for k in range(6)))
    assert take(one, block(3)) == [""]  # a block of the last minutes once more
    assert take(one, block(0, ahead_s=-7200.0), block(1, ahead_s=-7200.0)) == ["late", "late"]
    assert take(one, block(6, ahead_s=DAY)) == ["future"]
    assert one.state is not None
    position = one.state.position
    assert (position.blocks, position.repeated, position.late, position.future) == (6, 1, 2, 1)


def test_single_stamps_from_the_future_are_left_out_and_no_date_follows_them() -> None:
    one, wild = asset(), block(1)
    wild.t[-3:] += DAY
    assert take(one, block(0), wild, block(2)) == [""] * 3
    assert one.state is not None and one.state.position.t == block(2).t[-1]


def test_a_position_that_an_earlier_version_counted_in_the_future_is_given_up() -> None:
    one = asset()
    take(one, block(0, ahead_s=DAY), clock=math.inf)  # as before there was a policy
    assert take(one, block(1), block(2)) == ["", ""]
    assert one.state is not None and one.state.position.t == block(2).t[-1]


def test_how_an_asset_is_heard() -> None:
    """Oracle: the sentences of the documentation, one after the other."""
    log = ReceptionLog(heard_before=False)
    assert log.evaluate(0.0, 10.0, "", None).state == "unheard"
    down = log.evaluate(1.0, 10.0, "Not authorized", None)
    assert (down.state, down.why, down.source_down) == ("unheard", "Not authorized", True)
    log.refuse(2.0, "no block")
    assert log.evaluate(3.0, 10.0, "", None).why == "no block"
    log.hear(4.0)
    assert log.evaluate(14.0, 10.0, "a passing trouble", None).state == "followed"
    assert log.evaluate(14.1, 10.0, "", None).state == "silent"
    assert log.evaluate(5.0, 10.0, "", Reception("slow", "u comes every 50 ms, the loop needs 10")).state == "slow"


def example(name: str, port: int) -> str:
    """Return the first service file of a page, with a broker of this machine that asks for no password."""
    text = re.search(r"```toml\n(.*?)```", (DOCS / name).read_text(), re.DOTALL)
    assert text is not None
    kept = [line for line in text[1].splitlines() if not line.startswith(("tls", "user", "password_file"))]
    found = "\n".join(kept).replace('host = "broker.example"', f'host = "127.0.0.1"\nport = {port}')
    return 'name = "hall"\n[service]\nlisten = ""\nlog = "error"\n' + f"{found}\n"


def service_of(folder: Path, text: str) -> Service:
    (folder / "hall.toml").write_text(text)
    halls.baseline().save(folder / "press.json")
    config = ServiceFile.load(folder / "hall.toml")
    return Service(config, build_components(config))


def test_the_example_of_the_page_loses_no_block(tmp_path: Path, broker: Mosquitto) -> None:
    service = service_of(tmp_path, example("mqtt.md", broker.port))
    running, sender = Running(service), Sender(broker.port)
    until(lambda: not any(service.troubles["connection"].values()), 30.0)
    time.sleep(0.2)
    for k in range(60):
        sender.send(block(k, began=time.time() - 60.0))
        time.sleep(0.05)  # for longer than a client needs to come back and throw out the other
    press = service.assets["press"]
    until(lambda: press.heard and press.state is not None and press.state.position.blocks == 60, 30.0)
    assert press.state is not None and press.state.position.lost == 0
    assert not any(service.troubles["connection"].values()) and service.degraded_reason == ""
    sender.close()
    running.end(stop=True)


def test_two_clients_of_one_name_are_refused_before_anything_starts() -> None:
    text = example("mqtt.md", 1883)
    ServiceFile.model_validate(tomllib.loads(text))
    twice = text.replace("[outlets.plant]", '[outlets.plant]\nclient = "hall.plant"')
    why = r"\[outlets\] plant: client hall.plant at 127.0.0.1:1883 is that of \[sources\] plant too"
    with pytest.raises(ValueError, match=why):
        ServiceFile.model_validate(tomllib.loads(twice))
    elsewhere = twice.replace("port = 1883", "port = 1884", 1)  # another broker may give the same name
    ServiceFile.model_validate(tomllib.loads(elsewhere))


def test_a_client_that_is_thrown_out_by_one_of_its_name_says_so(tmp_path: Path, broker: Mosquitto) -> None:
    settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", port=broker.port)
    ours, theirs = (settings.create("hall.plant", {"press": STUB}, tmp_path) for _ in range(2))
    ours.open({})
    until(lambda: ours.connected, 30.0)
    assert not ours.trouble
    theirs.open({})
    until(lambda: "another client uses the name hall.plant too" in ours.trouble, 30.0)
    until(lambda: ours.connected, 30.0)
    assert ours.trouble  # it has come back, and will be thrown out again
    for one in (ours, theirs):
        one.close()


def test_to_leave_a_broker_is_no_loss(tmp_path: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    events = list[str]()
    monkeypatch.setattr(client, "log", lambda _level, event, **_: events.append(event))
    settings = MqttSourceSettings(kind="mqtt", host="127.0.0.1", port=broker.port)
    for visitor in (settings.for_visit().create(f"hall.{k}", {"press": STUB}, tmp_path) for k in range(2)):
        visitor.open({})
        until(lambda one=visitor: one.connected, 30.0)
        visitor.close()
    assert events == ["broker connected"] * 2


def test_an_action_for_connections_takes_those_of_all_sources() -> None:
    sinks = {"command": {"bell": {"argv": ["true"], "alarms": ["connection"]}}}
    alarms = AlarmSettings.model_validate({"connection": {"on_delay_s": 0.0}})
    notifier = Notifier("hall", alarms, ActionSettings.model_validate(sinks))
    result = notifier.check_service(0.0, {"connection": {"plant": "Not authorized", "plc": ""}}, NOW)
    assert [(one.alarm, one.cause) for one in result.transitions] == [("connection.plant", "Not authorized")]
    (row,) = notifier.notify(result.transitions, {}, NOW)
    assert row.table == "outbox" and row.values["event"]["alarm"] == "connection.plant"
    (shown,) = active_alarms({"hall": {"status": notifier.status}})
    assert (shown["priority"], shown["cause"]) == ("high", "Not authorized")
    resumed = Notifier("hall", AlarmSettings(definitions={}), ActionSettings())  # its definition has gone
    resumed.resume(notifier.checkpoint()["state"])
    assert active_alarms({"hall": {"status": resumed.status}}) == [{**shown, "priority": None}]
    assert notifier.check_service(0.0, {"connection": {"plant": ""}}, NOW + 1.0).transitions == []
    assert set(notifier.status["alarms"]) == {"buffering", "connection.plant"}  # one that has no source is forgotten


QUICK = "[alarms.connection]\non_delay_s = 0.1\n[alarms.reception]\non_delay_s = 0.1\n"


def test_a_dead_broker_and_an_asset_that_never_comes_are_alarms_from_the_start(
    tmp_path: Path, broker: Mosquitto
) -> None:
    text = example("mqtt.md", broker.port).replace("[outlets.plant]", "[outlets.board]") + QUICK
    dead = '[sources.dead]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = 1\n'
    service = service_of(tmp_path, f'{text}{dead}[assets.lift]\nbaseline = "press.json"\nsource = "dead"\n')
    running, config = Running(service), tmp_path / "hall.toml"
    server = serve_health(service.health_report(), "127.0.0.1:0")
    query = "SELECT asset, alarm FROM transitions WHERE after = 'unacknowledged' ORDER BY asset"
    # on a busy machine the board is not connected at once either
    until(lambda: set(asked(config, query)) >= {("hall", "connection.dead"), ("press", "reception")}, 30.0)
    assert set(asked(config, query)) <= {("hall", f"connection.{name}") for name in ("dead", "board", "plant")} | {
        ("press", "reception")
    }
    with urllib.request.urlopen(f"http://127.0.0.1:{server.server_address[1]}/health/ready", timeout=5.0) as answer:
        ready = json.load(answer)
    assert ready["ok"] and ready["degraded"].startswith("2 of 2 assets not followed, press for example")
    metrics = service.metrics.render().decode()
    assert 'servoscope_reception{asset="lift",source="dead",state="unheard"} 1.0' in metrics
    assert 'servoscope_connection_trouble{name="dead"} 1.0' in metrics
    assert 'servoscope_connection_trouble{name="plant"} 0.0' in metrics
    stored = {name: json.loads(status) for name, status in asked(config, "SELECT asset, status FROM checkpoints")}
    assert stored["press"]["summary"] == "Undetermined: nothing has ever come from it."
    assert stored["lift"]["reception"] == "unheard" and "refused" in stored["lift"]["summary"]
    sender = Sender(broker.port)
    sender.send(replace(block(0, began=time.time()), sequence=0))
    until(
        lambda: service.assets["press"].reception.state == "followed", 30.0
    )  # and from its first block on it is followed as ever
    press = service.assets["press"]
    assert press.state is not None and press.state.position.began < time.time()
    assert press.state.alarms["reception"].active  # for a while
    sender.close()
    running.end(stop=True)
    server.shutdown()
    server.server_close()


def test_the_table_of_somebody_who_has_just_connected_them(tmp_path: Path, broker: Mosquitto) -> None:
    service = service_of(tmp_path, example("mqtt.md", broker.port))  # it runs beside, and loses nothing to the visitor
    running, sender = Running(service), Sender(broker.port)
    until(lambda: not any(service.troubles["connection"].values()), 30.0)
    (tmp_path / "visit.toml").write_text(
        (tmp_path / "hall.toml").read_text() + '[assets.lift]\nbaseline = "press.json"\nsource = "plant"\n'
    )
    sending = Running(_Repeated(sender))
    said = CliRunner().invoke(app, ["run", str(tmp_path / "visit.toml"), "--check", "--online", "--for", "3"])
    sending.end(stop=True)
    assert said.exit_code == 1, said.output
    press, lift = (line for line in said.stdout.splitlines() if line.startswith(("press", "lift")))
    assert press.split()[:3] == ["press", "plant", "followed"] and "100" in press
    assert lift.split()[:3] == ["lift", "plant", "unheard"] and "nothing has ever come" in " ".join(said.stdout.split())
    state = service.assets["press"].state
    assert state is not None and state.position.lost == 0 and not any(service.troubles["connection"].values())
    refused = CliRunner().invoke(app, ["run", str(tmp_path / "hall.toml"), "--online"])
    assert isinstance(refused.exception, ConfigError) or refused.exit_code != 0
    sender.close()
    running.end(stop=True)


class _Repeated:
    """Sends a block every tenth of a second until it is stopped."""

    def __init__(self, sender: Sender) -> None:
        self._sender, self._stopping = sender, False

    def run(self) -> None:
        k, began = 0, time.time()
        while not self._stopping:
            self._sender.send(block(k, began=began - 30.0))
            k += 1
            time.sleep(0.1)

    def stop(self) -> None:
        self._stopping = True


def test_no_data_names_what_was_refused_since() -> None:
    reception = ReceptionLog(heard_before=False)
    reception.refuse(0.5, "an old reason")
    reception.hear(1.0)
    assert "old" not in reception.evaluate(1000.0, 10.0, "", None).why
    reception.refuse(2.0, "a.csv: is 120 s ahead")
    found = reception.evaluate(1000.0, 10.0, "", None)
    assert found.state == "silent" and found.why == "no data come; what came instead: a.csv: is 120 s ahead"
