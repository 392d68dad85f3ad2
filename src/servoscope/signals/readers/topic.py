"""What a topic of an MQTT broker brings for a while, by an address such as ``mqtt:plant-broker/axis/1?seconds=30``."""

from __future__ import annotations

import functools
import json
import time
from pathlib import Path
from typing import Any

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.addresses import TableAddress
from servoscope.signals.readers.guess_columns import guess_columns
from servoscope.signals.readers.records import open_records
from servoscope.signals.readers.table import TableFile

SECONDS = 60.0  # that are listened to, unless the address says otherwise
MAX_RECORDS = 400_000  # after which enough is known
POLL_S = 0.05
TIMEOUT_S = 10.0  # of the connection


def open_topic(address: TableAddress) -> TableFile:
    """Listen to a topic and open the records that came, one message of JSON each; what came is kept for this process.

    Raises RecordingError if the broker cannot be reached, or no message is a record.
    """
    address.require("paho", "mqtt")
    wanted = address.equal.pop("seconds", str(SECONDS))
    broker, _, topic = address.place.partition("/")
    if not topic or address.equal or not wanted.replace(".", "", 1).isdigit():
        raise RecordingError(f"{address.text}: is no topic, write mqtt:HOST:PORT/TOPIC?seconds={SECONDS:g}")
    records = _listen(address.setting()[1] or broker, topic, float(wanted), address.text)
    return open_records(Path(address.text), records)


@functools.lru_cache(4)  # a command opens what it reads several times
def _listen(broker: str, topic: str, seconds: float, name: str) -> list[dict[str, Any]]:
    """Return the records of a topic; `broker`: HOST:PORT, with USER:PASSWORD@ before it where they are needed."""
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    account, _, place = broker.rpartition("@")
    host, _, port = place.partition(":")
    records: list[dict[str, Any]] = []

    def subscribe(*_: object) -> None:
        client.subscribe(topic)

    def receive(client: Client, data: object, message: Any) -> None:
        try:
            record = json.loads(message.payload)
        except ValueError:
            return
        if isinstance(record, dict):
            clock = {} if "t" in guess_columns(list(record)) else {"time": time.time()}  # of its arrival
            records.append({**clock, **record})

    client = Client(CallbackAPIVersion.VERSION2)
    client.connect_timeout = TIMEOUT_S
    client.on_connect = subscribe
    client.on_message = receive
    if account:
        client.username_pw_set(*account.split(":", 1))
    try:
        client.connect(host, int(port or 1883))
    except (OSError, ValueError) as error:
        raise RecordingError(f"{name}: {place} cannot be reached ({error}), check host and port") from None
    client.loop_start()
    end = time.monotonic() + seconds
    while time.monotonic() < end and len(records) < MAX_RECORDS:
        time.sleep(POLL_S)
    client.disconnect()
    client.loop_stop()
    if not records:
        raise RecordingError(f"{name}: no record in JSON came in {seconds:g} s, check the topic")
    return records
