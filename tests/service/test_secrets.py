"""Secrets planted in addresses: none is in a message, the log, or the outcome of a delivery, which is stored."""

from __future__ import annotations

import io
import json
import logging
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from commands import run
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from servoscope.core.addresses import hide_secrets, show_address
from servoscope.core.errors import StoreError
from servoscope.core.settings_errors import describe_error
from servoscope.service.actions import ActionSettings, OutboxEntry, deliver
from servoscope.service.log import log, set_up_logging
from servoscope.service.opcua.source import OpcuaSourceSettings, OpcuaTransport
from servoscope.service.store import Store
from servoscope.service.store.engine import display_url, parse_store_url

SECRET = "hush0"  # followed by a number: each says where it was planted
WORDS = st.text("abcdefghijklmnopqrstuvwxyz0123456789", min_size=1, max_size=12)


def planted(scheme: str, host: str) -> str:
    """Return an address with a secret in every part that can hold one."""
    return f"{scheme}://{SECRET}1:{SECRET}2@{host}/{SECRET}3?token={SECRET}4#{SECRET}5"


@given(WORDS, WORDS, WORDS, st.none() | st.integers(1, 65535))
def test_an_address_is_shown_by_scheme_host_and_port(user: str, path: str, token: str, port: int | None) -> None:
    where = "example.org" + (f":{port}" if port else "")
    url = f"https://{user}:{token}@{where}/{path}?t={token}#{path}"
    assert show_address(url) == f"https://{where}"
    assert hide_secrets(f"it is {url} that fails") == f"it is https://{where} that fails"


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("http://[::1]:80/x", "http://[::1]:80"),
        ("http://hush0@host:hush0/x", "http://..."),
        ("http://[hush0", "http://..."),
        ("hush0:hush0@host", "..."),
        ("https:hush0", "..."),
        ("file:///hush0", "file://..."),
        ("", "..."),
    ],
)
def test_what_is_no_address_is_hidden(url: str, shown: str) -> None:
    assert show_address(url) == shown


def test_quotes_and_brackets_around_an_address_stay() -> None:
    said = hide_secrets(f"['{planted('http', 'a:1')}', (\"{planted('http', 'b')}\")]; http://u:it's{SECRET}@c.")
    assert said == "['http://a:1', (\"http://b\")]; http://c."


@given(st.text())
def test_any_text_may_stand_for_an_address(text: str) -> None:
    assert SECRET not in hide_secrets(f"http://{SECRET}@{SECRET}.{SECRET}/").replace(f"{SECRET}.{SECRET}", "")
    assert isinstance(show_address(text) + hide_secrets(text), str)


def attempt(settings: ActionSettings) -> str:
    row = OutboxEntry("0", "desk", {"event": "occur"}, created=time.time(), due=0.0)
    return deliver(row, settings, time.time()).detail


def test_an_attempt_at_a_webhook_tells_no_more_than_where_it_went(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")

    class Refusal(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(500)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Refusal)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    host = f"127.0.0.1:{server.server_port}"
    settings = ActionSettings.model_validate({"webhook": {"desk": {"url": planted("http", host)}}})
    try:
        assert attempt(settings) == f"http://{host}: answered 500"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    failure = attempt(settings)  # nobody listens any more
    assert failure.startswith(f"http://{host}: ") and SECRET not in failure


@pytest.mark.parametrize("url", [planted("ftp", "host"), f"{SECRET}:{SECRET}@host/{SECRET}", f"https:{SECRET}"])
def test_an_address_that_is_refused_is_not_repeated(url: str) -> None:
    with pytest.raises(ValidationError) as caught:
        ActionSettings.model_validate({"webhook": {"desk": {"url": url}}})
    said = describe_error(caught.value, ActionSettings, section="actions")
    assert "webhook.desk.url" in said and "http://" in said and SECRET not in said
    with pytest.raises(ValidationError) as caught:
        OpcuaSourceSettings.model_validate({"kind": "opcua", "url": url})
    said = describe_error(caught.value, OpcuaSourceSettings, section="sources")
    assert "url" in said and "opc.tcp://" in said and SECRET not in said


def test_a_value_of_the_wrong_kind_shows_no_address() -> None:
    with pytest.raises(ValidationError) as caught:
        ActionSettings.model_validate({"webhook": {"desk": {"url": [planted("http", "host")]}}})
    assert SECRET not in describe_error(caught.value, ActionSettings, section="actions")


def test_the_name_of_a_store_holds_no_secret(tmp_path: Path) -> None:
    url = f"postgresql://servo:{SECRET}1@127.0.0.1:1/plant?sslpassword={SECRET}2&password={SECRET}3"
    assert display_url(parse_store_url(url, tmp_path)) == "postgresql://127.0.0.1:1"
    for wrong in (url, f"sqlite://{SECRET}:{SECRET}@host", f"postgresql://{SECRET}\0@host/x"):
        with pytest.raises(StoreError) as caught:
            Store.open(wrong, tmp_path)
        assert SECRET not in str(caught.value)
    done = run("watch", url, "--once")
    assert done.code and "postgresql://127.0.0.1:1" in done.err and SECRET not in done.err + done.out


def test_the_log_hides_what_addresses_hold_wherever_they_stand() -> None:
    stream = io.StringIO()
    loggers = [logging.getLogger(name) for name in ("servoscope", "asyncua", "psycopg")]
    before = [(one, one.handlers[:], one.propagate, one.level) for one in loggers]
    try:
        set_up_logging("debug", stream)
        source = OpcuaSourceSettings(kind="opcua", url=planted("opc.tcp", "127.0.0.1:1"))
        OpcuaTransport(source, {}, Path())._log_trouble("the server is away")
        log("info", f"went to {planted('http', 'host')}", why=f"{planted('mqtt', 'broker')}: refused")
        log("info", "nested", document={"urls": [planted("https", "host")]})
        logging.getLogger("asyncua").warning("lost %s", planted("opc.tcp", "host"))
        try:
            raise ValueError(planted("http", "host"))
        except ValueError:
            logging.getLogger("servoscope.web").error("failed", exc_info=True)
    finally:
        for one, handlers, propagate, level in before:
            one.handlers[:], one.propagate = handlers, propagate
            one.setLevel(level)
    text = stream.getvalue()
    lines = [json.loads(line) for line in text.splitlines()]
    assert len(lines) == 5 and SECRET not in text
    assert lines[0]["url"] == "opc.tcp://127.0.0.1:1" and lines[1]["why"] == "mqtt://broker: refused"
