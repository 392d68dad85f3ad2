"""A plant's own messages, as fourteen makers document them, followed through a real broker into the store."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import halls
import numpy as np
import plant_writers as plants
import pytest
from brokers import Running, Sender, kafka_brokers, kafka_cluster, started_broker, until
from halls import asked
from reliability.servers import Mosquitto

from servoscope.service.build import build_components
from servoscope.service.commissioning import listen
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service
from servoscope.service.sources import inbox
from servoscope.service.sources.block import Block

RATE = 100.0
SECONDS = 4.0


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    server = started_broker(tmp_path_factory.mktemp("broker"))
    yield server
    server.stop(signal.SIGKILL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("hall")
    halls.files(made)
    return made


def service_file(folder: Path, name: str, port: int, payload: str, assets: tuple[str, ...] = ("press", "lift")) -> Path:
    tables = "\n".join(f'[assets.{one}]\nbaseline = "baseline.json"\nsource = "plant"' for one in assets)
    path = folder / f"{name}.toml"
    path.write_text(
        f'name = "{name}"\n[service]\nlisten = ""\ncommit_every_s = 0.05\nlog = "error"\n'
        f'[store]\nurl = "{name}.sqlite"\n'
        f'[sources.plant]\nkind = "mqtt"\nhost = "127.0.0.1"\nport = {port}\n'
        f"[sources.plant.payload]\nblock = 0.25\n{payload}\n"
        f"{tables}\n"
    )
    return path


def start(path: Path) -> Running:
    config = ServiceFile.load(path)
    service = Service(config, build_components(config))
    until(lambda: service.sources["plant"].connected)
    time.sleep(0.2)  # the broker has the subscriptions by then
    return Running(service)


def stored(path: Path, asset: str) -> np.ndarray:
    """Return t, r, u, y of all samples of an asset in the store, shape (4, N)."""
    rows = asked(path, f"SELECT sequence, samples FROM recent WHERE asset = '{asset}' ORDER BY sequence")
    blocks = [Block.unpack(asset, *row).signals for row in rows]
    return np.concatenate(blocks, axis=1) if blocks else np.zeros((4, 0))


def send(sender: Sender, messages: Iterator[plants.Message] | list[plants.Message]) -> None:
    last = None
    for topic, payload in messages:
        last = sender.client.publish(topic, payload, qos=1)
    if last is not None:
        last.wait_for_publish(30.0)


@pytest.mark.parametrize("name", plants.WRITERS)
def test_what_a_plant_sends_is_in_the_store_and_what_is_broken_costs_itself(
    name: str, folder: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox, "MAX_QUIET_S", 0.5)
    path = service_file(folder, f"hall{list(plants.WRITERS).index(name)}", broker.port, plants.form(name)[0])
    running, sender = start(path), Sender(broker.port)
    begin = round(time.time()) - 60.0
    rows = {asset: plants.signals(asset, SECONDS, RATE, begin) for asset in ("press", "lift")}
    sent = {asset: list(plants.WRITERS[name](asset, rows[asset])) for asset in rows}
    topic, good = sent["press"][-1][0], sent["press"][0][1]
    broken = [b"", b"\xff\xfe\xfd", good[: len(good) // 2], b'{"what": "is this"}']
    half = len(sent["press"]) // 2
    send(sender, sent["press"][:half])
    send(sender, [(topic, one) for one in broken])
    send(sender, sent["press"][half:] + sent["lift"])
    short = 1.0 / RATE  # the last moment of single values is open until the next one
    until(lambda: all(stored(path, a)[0, -1:].sum() >= rows[a][0, -1] - 1.5 * short for a in rows), 30.0)
    told = until(lambda: {who for (who,) in asked(path, "SELECT asset FROM audit WHERE what = 'refused'")}, 30.0)
    running.end(stop=True)
    sender.close()
    for asset, true in rows.items():
        found = stored(path, asset)
        n = found.shape[1]
        assert n >= true.shape[1] - 1
        np.testing.assert_allclose(found[0], true[0, :n], rtol=0.0, atol=1e-3)
        np.testing.assert_array_equal(found[1:], true[1:, :n])
    assert told == ({"press"} if "press" in topic else {"plant"})  # where no topic says of whom they are, the source


def test_two_services_at_one_broker_each_receive_their_own_assets_only(
    folder: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox, "MAX_QUIET_S", 0.5)
    table, begin = plants.form("Insights Hub")[0], round(time.time()) - 60.0
    paths = {one: service_file(folder, f"only-{one}", broker.port, table, (one,)) for one in ("press", "lift")}
    running, sender = {one: start(path) for one, path in paths.items()}, Sender(broker.port)
    for asset in paths:
        send(sender, plants.insights(asset, plants.signals(asset, 2.0, RATE, begin)))
    until(lambda: all(stored(path, asset).shape[1] == 200 for asset, path in paths.items()), 30.0)
    sender.close()
    for asset, path in paths.items():
        running[asset].end(stop=True)
        assert {who for (who,) in asked(path, "SELECT DISTINCT asset FROM recent")} == {asset}
        assert not asked(path, "SELECT * FROM audit WHERE what = 'refused'")  # what is not its own did not come


def test_a_visit_tells_what_came_instead_of_an_asset_that_is_never_heard(folder: Path, broker: Mosquitto) -> None:
    table = plants.form("Insights Hub")[0]
    path, sender = service_file(folder, "visit", broker.port, table, ("press",)), Sender(broker.port)
    messages = list(plants.insights("presse", plants.signals("presse", 10.0, RATE, time.time())))

    def talk() -> None:
        for one in messages:
            send(sender, [one])
            time.sleep(0.2)

    talking = threading.Thread(target=talk)
    talking.start()
    (row,) = listen(ServiceFile.load(path), 3.0)
    talking.join()
    sender.close()
    assert row.reception.state == "unheard" and "row of 'presse'" in row.reception.why


def test_a_node_whose_births_were_missed_is_asked_for_them(folder: Path, broker: Mosquitto) -> None:
    path = service_file(folder, "rebirth", broker.port, plants.form("Sparkplug B")[0], ("press",))
    running, sender, asked_for = start(path), Sender(broker.port), list[str]()
    sender.client.on_message = lambda *words: asked_for.append(words[-1].topic)
    sender.client.subscribe("spBv1.0/+/NCMD/+")
    rows = plants.signals("press", 1.0, RATE, time.time() - 10.0)
    send(sender, [one for one in plants.sparkplug("press", rows) if "BIRTH" not in one[0]])
    until(lambda: asked_for, 30.0)
    running.end(stop=True)
    sender.close()
    assert asked_for == ["spBv1.0/hall/NCMD/plc1"]


def test_kafka_gives_a_service_its_own_assets_and_what_is_broken_costs_itself(folder: Path) -> None:
    producer, begin = kafka_cluster(), round(time.time()) - 60.0
    for asset in ("press", "lift"):
        for _, payload in plants.insights(asset, plants.signals(asset, 2.0, RATE, begin)):
            producer.produce("axes", key=asset.encode(), value=payload)
        producer.produce("axes", key=asset.encode(), value=b"{")
    producer.flush(30.0)
    payload = 'topics = ["axes/{asset}"]\ntime = { _time = "iso" }'
    path = service_file(folder, "kafka", 1, payload, ("press",))
    path.write_text(
        path.read_text().replace(
            'kind = "mqtt"\nhost = "127.0.0.1"\nport = 1',
            f'kind = "kafka"\nstart = "beginning"\nbrokers = {json.dumps(kafka_brokers(producer))}',
        )
    )
    running = start(path)
    until(lambda: stored(path, "press").shape[1] == 200, 60.0)
    told = until(lambda: asked(path, "SELECT asset, document FROM audit WHERE what = 'refused'"), 30.0)
    running.end(stop=True)
    np.testing.assert_array_equal(stored(path, "press")[1:], plants.signals("press", 2.0, RATE, begin)[1:])
    assert [who for who, _ in told] == ["press"] and json.loads(told[0][1])["count"] == 1
    producer.flush(1.0)
