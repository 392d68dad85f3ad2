"""What a live topic brings, read as a log."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from brokers import started_broker
from logs import signals
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

import servoscope as ss
from servoscope.core.errors import RecordingError
from servoscope.models.loop import Columns
from servoscope.signals.readers import read


def test_records_of_a_topic_are_a_log(tmp_path: Path) -> None:
    broker = started_broker(tmp_path)
    try:
        address = f"mqtt:127.0.0.1:{broker.port}/axis/+?seconds=3"
        client = Client(CallbackAPIVersion.VERSION2)
        client.connect("127.0.0.1", broker.port)
        client.loop_start()
        data, done = signals(), threading.Event()

        def send() -> None:
            done.wait(1.0)  # until somebody listens
            client.publish("axis/1", b"no record")
            for t, r, u, y in zip(*(x.tolist() for x in data.values()), strict=True):
                client.publish("axis/1", json.dumps({"t": t, "axis": {"setpoint": r, "current": u, "position": y}}))

        sender = threading.Thread(target=send)
        sender.start()
        columns = Columns(reference="axis.setpoint", input="axis.current", output="axis.position")
        recording = read(address, columns=columns)
        sender.join()
        np.testing.assert_array_equal(recording.y, data["y"])
        assert ss.init(address).loop.columns.input == "axis.current"  # of what came before
        with pytest.raises(RecordingError, match=r"no record in JSON came in 0\.1 s, check the topic"):
            read(f"mqtt:127.0.0.1:{broker.port}/other?seconds=0.1")
    finally:
        client.loop_stop()
        broker.stop()
    with pytest.raises(RecordingError, match="cannot be reached"):
        read("mqtt:127.0.0.1:1/axis")
    with pytest.raises(RecordingError, match=r"is no topic, write mqtt:HOST:PORT/TOPIC\?seconds=60"):
        read("mqtt:plant/axis?seconds=soon")
