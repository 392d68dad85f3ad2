"""Mails about alarms, handed to a real server: encrypted, one for each episode, no more than an hour takes."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from brokers import until
from mail_server import MailServer
from pydantic import ValidationError
from test_network import certificate

from servoscope.service.actions import ActionSettings, OutboxEntry, deliver, diagnosis_entries, transition_entries
from servoscope.service.actions import mail as mail_module
from servoscope.service.actions.dispatcher import OutboxDispatcher
from servoscope.service.alarms import (
    AlarmSettings,
    AlarmTransition,
    LifecycleEvent,
    LifecycleState,
    initial_alarm_state,
)
from servoscope.service.asset_link import qr_code
from servoscope.service.clock import SteadyClock
from servoscope.service.notifications import Notifier
from servoscope.service.store import Batch, Store

NOW = 1.7e9
NEW = AlarmTransition(
    NOW, "press 1", "fault", 7, LifecycleState.NORMAL, LifecycleState.UNACKNOWLEDGED, LifecycleEvent.OCCUR,
    "leakage \u00fc", "system",
)  # fmt: skip


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    for name, issuer in (("root", None), ("other", None), ("localhost", "root")):
        certificate(folder, name, issuer)
    return folder


@pytest.fixture
def serve(keys: Path) -> Iterator[Callable[[str], tuple[MailServer, dict[str, Any]]]]:
    """Start a server of an encryption, and return it with the settings for it."""
    running: list[MailServer] = []

    def start(encryption: str) -> tuple[MailServer, dict[str, Any]]:
        running.append(MailServer(keys, encryption))
        settings = {"host": "localhost", "port": running[-1].port, "encryption": encryption}
        if encryption != "none":
            settings |= {"user": "hall", "secret_env": "MAIL_PASSWORD", "ca_file": str(keys / "root.pem")}
        return running[-1], settings

    yield start
    for one in running:
        one.stop()


@pytest.fixture(autouse=True)
def password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAIL_PASSWORD", "hush")


MAIL = {"sender": "servoscope@plant.example", "to": ("shift@plant.example", "chief@plant.example")}


def settings_of(**keys: Any) -> ActionSettings:
    return ActionSettings.model_validate({"email": {"shift": {"host": "localhost", **MAIL, **keys}}})


def entry(settings: ActionSettings, transition: AlarmTransition = NEW) -> OutboxEntry:
    (row,) = transition_entries(settings, transition, "high", NOW, {"operator_action": "look at the seal"})
    return row


@pytest.mark.parametrize("encryption", ["starttls", "tls"])
def test_a_mail_is_plain_text_with_a_link_and_its_qr_code_over_an_encrypted_connection(
    encryption: str, serve: Callable[[str], tuple[MailServer, dict[str, Any]]]
) -> None:
    inbox, keys = serve(encryption)
    settings = settings_of(**keys)
    row = entry(settings)
    row.event["link"] = "https://hall.example/assets/press%201"
    result = deliver(row, settings, NOW)
    assert result.delivered, result.detail
    (mail,) = inbox.mails
    assert mail["Subject"] == "[servoscope] press 1: fault, high, unacknowledged"
    assert mail["From"] == MAIL["sender"] and mail["To"] == "shift@plant.example, chief@plant.example"
    assert mail["Message-ID"] == f"<{row.key}@servoscope>"
    (code,) = mail.iter_attachments()
    assert code.get_content() == qr_code("https://hall.example/assets/press%201", "png")
    body = mail.get_body(("plain",))
    assert body is not None and body.get_content().splitlines() == [
        "press 1: fault, high, unacknowledged",
        "leakage \u00fc",
        "look at the seal",
        "Since 2023-11-14 22:13:20 UTC.",
        "https://hall.example/assets/press%201",
    ]


def test_what_keeps_a_mail_from_its_server_is_told_and_it_is_tried_again(
    serve: Callable[[str], tuple[MailServer, dict[str, Any]]], keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inbox, good = serve("starttls")
    for words, changed in (
        ("certificate verify failed", {"ca_file": str(keys / "other.pem")}),
        ("doesn't match|not valid for", {"host": "127.0.0.1"}),
        ("Authentication", {"user": "somebody"}),
        ("refused", {"port": 1}),
        ("internal address, which \\[network\\] refuses", {"network": {"internal": False}}),
        ("holds no secret", {"secret_env": "NOT_SET"}),
    ):
        settings = settings_of(**{**good, **changed})
        result = deliver(entry(settings), settings, NOW)
        assert not result.delivered and result.retry_entry is not None
        assert "hush" not in result.detail
        assert re.search(words, result.detail), result.detail
    assert not inbox.mails
    _, plain = serve("none")
    settings = settings_of(**{**plain, "encryption": "starttls"})
    assert "STARTTLS" in deliver(entry(settings), settings, NOW).detail  # nothing goes in the clear


def test_a_try_has_a_deadline_even_where_the_server_drips() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        stop = threading.Event()

        def drip() -> None:
            connection, _ = listener.accept()
            with connection:
                while not stop.wait(0.05):
                    try:
                        connection.sendall(b"220-wait\r\n")
                    except OSError:
                        return

        thread = threading.Thread(target=drip)
        thread.start()
        settings = settings_of(host="127.0.0.1", port=listener.getsockname()[1], encryption="none", timeout_s=0.5)
        begin = time.monotonic()
        result = deliver(entry(settings), settings, NOW)
        assert time.monotonic() - begin < 1.5
        assert "not taken within 0.5 s" in result.detail
        stop.set()
        thread.join()


def test_the_deadline_holds_in_the_handshake_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            connection, _ = listener.accept()
            with connection:
                for line in (b"220 ready\r\n", b"250-here\r\n250 STARTTLS\r\n", b"220 go ahead\r\n"):
                    time.sleep(0.25)
                    connection.sendall(line)
                    connection.recv(1000)
                connection.settimeout(5.0)
                connection.recv(1000)  # no handshake comes back: it ends when the other side does

        thread = threading.Thread(target=answer)
        thread.start()
        settings = settings_of(host="127.0.0.1", port=listener.getsockname()[1], timeout_s=1.0)
        begin = time.monotonic()
        result = deliver(entry(settings), settings, NOW)
        assert time.monotonic() - begin < 1.4
        assert "not taken within 1 s" in result.detail
        thread.join()


def test_an_episode_of_an_alarm_is_one_mail() -> None:
    settings = settings_of()
    again = replace(NEW, before=LifecycleState.RETURNED, sequence=9)
    ended = replace(NEW, before=LifecycleState.UNACKNOWLEDGED, after=LifecycleState.RETURNED)
    next_one = replace(NEW, sequence=11, time=NOW + 60.0)
    entries = [transition_entries(settings, one, "high", NOW) for one in (NEW, again, ended, next_one)]
    assert [len(one) for one in entries] == [1, 0, 0, 1]
    alarm = replace(initial_alarm_state("press 1", "fault", NOW), state=LifecycleState.UNACKNOWLEDGED)
    assert not diagnosis_entries(settings, alarm, "high", NOW, NOW, "leakage", {})


def test_more_than_an_hour_takes_waits_and_comes_as_one_mail(
    serve: Callable[[str], tuple[MailServer, dict[str, Any]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mail_module, "HOUR_S", 3.0)
    inbox, keys = serve("none")
    settings = settings_of(**keys, per_hour=2)
    store = Store.open(str(tmp_path / "s.sqlite"), write=True)
    rows = []
    for k in range(30):
        one = entry(settings, replace(NEW, asset=f"press{k}", sequence=k))
        rows.append({**one.to_dict(), "event": {**one.event, "service": "hall"}, "outcome": ""})
    made = Batch()
    made.rows["outbox"] = rows
    store.write(made, "hall", 1)
    dispatcher = OutboxDispatcher(store, "hall", settings, SteadyClock())
    dispatcher.start()
    attempts = []

    def store_attempts(number: list[int] = [1]) -> int:  # noqa: B006
        for one in dispatcher.take_attempts():
            assert one.delivered, one.detail
            attempts.append(one.entry.key)
            number[0] += 1
            done = Batch()
            done.deliveries[one.entry.key] = {"attempts": 1, "due": None, "outcome": one.detail}
            store.write(done, "hall", number[0])
        return len(attempts)

    until(lambda: store_attempts() == 2, 30.0)
    time.sleep(1.0)
    assert store_attempts() == 2 and len(inbox.mails) == 2
    until(lambda: store_attempts() == 30, 30.0)
    time.sleep(0.7)
    dispatcher.stop()
    assert len(inbox.mails) == 3 and len(set(attempts)) == 30
    assert inbox.mails[2]["Subject"] == "[hall] 28 alarms"
    assert inbox.mails[2].get_content().count("leakage") == 28
    store.close()


def test_settings_that_would_send_a_password_in_the_clear_or_to_nobody_are_refused() -> None:
    for words, keys in (
        ("in the clear", {"user": "hall", "secret_env": "X", "encryption": "none"}),
        ("user: give it with", {"user": "hall"}),
        ("not both", {"user": "hall", "secret_env": "X", "secret_file": "y"}),
        ("to.0", {"to": ("shift@plant.example\nBcc: all@plant.example",)}),
        ("to", {"to": ()}),
    ):
        with pytest.raises(ValidationError, match=words):
            settings_of(**keys)
    assert json.dumps(settings_of().email["shift"].model_dump(mode="json"))


def test_each_outlet_with_the_address_of_the_pages_sends_a_link() -> None:
    page = {"address": "https://hall.example/"}
    sinks = {
        "webhook": {"desk": {"url": "http://desk", **page}},
        "mqtt": {"bus": {"broker": {"host": "bus"}, "topic": "alarms", **page}},
        "command": {"bell": {"argv": ["ring", "{link}"], **page}, "horn": {"argv": ["true"]}},
        "email": {"shift": {"host": "localhost", **MAIL, **page}},
    }
    notifier = Notifier("hall", AlarmSettings(), ActionSettings.model_validate(sinks))
    for asset, link in (("press 1", "https://hall.example/assets/press%201"), ("hall", "https://hall.example/")):
        rows = notifier.notify([replace(NEW, asset=asset)], {}, NOW)
        links = {row.values["sink"]: row.values["event"].get("link") for row in rows}
        assert links == {"desk": link, "bus": link, "bell": link, "horn": None, "shift": link}
