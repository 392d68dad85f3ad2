"""Networks that the service must not reach, names that change their address, and who has to prove an identity."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import ipaddress
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import halls
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from pydantic import ValidationError
from typer.testing import CliRunner

from servoscope.cli import app
from servoscope.core.errors import ConfigError, ObsoleteSettingWarning
from servoscope.service.actions import ActionSettings, OutboxEntry, deliver
from servoscope.service.config import ServiceFile
from servoscope.service.mqtt.client import BrokerSettings, create_mqtt_client
from servoscope.service.network import NetworkSettings
from servoscope.service.opcua.source import OpcuaSourceSettings, create_opcua_client

NAME = "hook.example"  # which is nobody's
PUBLIC_ONLY = {"internal": False}
LOOPBACK_TOO = {"internal": False, "allowed": ["127.0.0.0/8"]}


class Names:
    """Addresses by name: each question takes the next of a name's, and the last for good."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.addresses: dict[str, list[list[str]]] = {}
        self.asked: list[str] = []
        self._resolve = socket.getaddrinfo
        monkeypatch.setattr(socket, "getaddrinfo", self._find)

    def _find(self, host: Any, port: Any, *arguments: Any, **more: Any) -> Any:
        host = host.decode() if isinstance(host, bytes) else host
        if host not in self.addresses:
            return self._resolve(host, port, *arguments, **more)
        self.asked.append(host)
        left = self.addresses[host]
        found = left.pop(0) if len(left) > 1 else left[0]
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (one, port)) for one in found]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    return Names(monkeypatch)


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "*")


@contextlib.contextmanager
def receiving(context: ssl.SSLContext | None = None, status: int = 200) -> Iterator[tuple[int, list[str]]]:
    """Yield a port of the loopback interface, and the ``Host`` of each request that comes there."""
    heard: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            heard.append(self.headers["Host"])
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(status)
            self.send_header("Location", f"http://127.0.0.1:{server.server_port}/again")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda *_: None  # type: ignore[method-assign]  # clients that trust nobody hang up
    if context is not None:
        server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port, heard
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def attempt(url: str, folder: Path = Path(), **more: Any) -> tuple[bool, str]:
    settings = ActionSettings.model_validate({"webhook": {"desk": {"url": url, **more}}})
    row = OutboxEntry("0", "desk", {"event": "occur"}, created=time.time(), due=0.0)
    done = deliver(row, settings, time.time(), folder)
    return done.delivered, done.detail


@pytest.mark.parametrize(
    ("address", "reached"),
    [
        *(("8.8.8.8", True), ("2001:4860:4860::8888", True)),
        *(("10.1.2.3", False), ("127.0.0.1", False), ("169.254.169.254", False), ("100.64.0.1", False)),
        *(("0.0.0.0", False), ("::1", False), ("fd00::1", False), ("fe80::1", False), ("224.0.0.1", False)),
        *(("fec0::1", False), ("ff0e::1", False), ("5f00::1", False), ("255.255.255.255", False), ("::", False)),
        *(("::ffff:8.8.8.8", True), ("64:ff9b::8.8.8.8", True)),  # IPv4 in IPv6, of a public host
        *(("::ffff:10.1.2.3", False), ("::ffff:7f00:1", False), ("::127.0.0.1", False)),  # mapped, compatible
        *(("::ffff:0:7f00:1", False), ("::ffff:0:127.0.0.1", False)),  # translated
        *(("64:ff9b::10.1.2.3", False), ("64:ff9b:1::7f00:1", False), ("64:ff9b:1:7f00:0:100::", False)),  # NAT64
        *(("2002:7f00:1::", False), ("2002:a01:203::1", False)),  # 6to4
        *(("2001::7f00:1", False), ("2001:0:4136:e378:8000:63bf:80ff:fffe", False)),  # Teredo
        *(("192.88.99.1", False), ("192.88.98.1", True), ("3fff::1", False), ("3fff:1000::1", True)),
        *(("192.168.7.7", True), ("::ffff:192.168.7.7", True), ("192.168.7.8", False)),  # the exception
    ],
)
def test_internal_networks_are_refused_but_for_exceptions(address: str, reached: bool) -> None:
    rules = NetworkSettings(internal=False, allowed=("192.168.7.7",))
    if reached:
        assert ipaddress.ip_address(rules.resolve(address, 80)) == ipaddress.ip_address(address)
    else:
        with pytest.raises(PermissionError, match="refuses"):
            rules.resolve(address, 80)


def test_of_several_addresses_one_that_is_permitted_is_taken(names: Names) -> None:
    names.addresses[NAME] = [["10.0.0.1", "8.8.8.8"]]
    assert NetworkSettings(internal=False).resolve(NAME, 80) == "8.8.8.8"
    assert NetworkSettings().resolve(NAME, 80) == NAME  # without rules nothing is looked up


@pytest.mark.parametrize(
    "wrong", [{"allowed": ("10.0.0.0/8",)}, {"internal": "no"}, {"internal": False, "allowed": ("10.0.0.0/99",)}]
)
def test_rules_that_mean_nothing_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        NetworkSettings(**wrong)


def test_a_webhook_does_not_reach_a_refused_network() -> None:
    with receiving() as (port, heard):
        done, detail = attempt(f"http://localhost:{port}/x", network=PUBLIC_ONLY)
        assert not done and "is an internal address, which [network] refuses" in detail and heard == []
        assert attempt(f"http://localhost:{port}/x", network=LOOPBACK_TOO)[0] and heard == [f"localhost:{port}"]


def test_a_name_that_changes_between_the_look_and_the_connection_gains_nothing(names: Names) -> None:
    names.addresses[NAME] = [["8.8.8.8"], ["127.0.0.1"]]
    rules = NetworkSettings(**PUBLIC_ONLY)
    assert rules.resolve(NAME, 80) == "8.8.8.8"
    names.addresses[NAME], names.asked = [["127.0.0.1"], ["203.0.113.1"]], []
    with receiving() as (port, heard):
        assert attempt(f"http://{NAME}:{port}/x", network=LOOPBACK_TOO) == (True, "answered 200")
        assert heard == [f"{NAME}:{port}"] and names.asked == [NAME]  # asked once: what was checked is what it went to


def test_a_redirect_is_not_followed() -> None:
    with receiving(status=307) as (port, heard):
        assert not attempt(f"http://127.0.0.1:{port}/x")[0] and len(heard) == 1


def certificate(folder: Path, name: str, issuer: str | None = None) -> None:
    """Write NAME.pem and NAME.key, signed by itself or by another one."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    signer, signed_by = key, subject
    if issuer is not None:
        signed_by = x509.load_pem_x509_certificate((folder / f"{issuer}.pem").read_bytes()).subject
        loaded = serialization.load_pem_private_key((folder / f"{issuer}.key").read_bytes(), None)
        assert isinstance(loaded, ec.EllipticCurvePrivateKey)
        signer = loaded
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder(signed_by, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.BasicConstraints(issuer is None, None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
        .sign(signer, hashes.SHA256())
    )
    (folder / f"{name}.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
    plain = serialization.NoEncryption(), serialization.PrivateFormat.PKCS8
    (folder / f"{name}.key").write_bytes(key.private_bytes(serialization.Encoding.PEM, plain[1], plain[0]))


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    for name, issuer in (("root", None), ("other", None), (NAME, "root"), ("us", "root")):
        certificate(folder, name, issuer)
    return folder


def test_over_https_both_sides_prove_who_they_are(keys: Path, names: Names) -> None:
    names.addresses[NAME] = names.addresses["wrong.example"] = [["127.0.0.1"]]
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(keys / "root.pem"))
    context.load_cert_chain(keys / f"{NAME}.pem", keys / f"{NAME}.key")
    context.verify_mode = ssl.CERT_REQUIRED
    ours = {"cert_file": "us.pem", "key_file": "us.key"}
    with receiving(context) as (port, heard):
        url = f"https://{NAME}:{port}/x"
        for network in (LOOPBACK_TOO, None):  # to an address that was checked, and as httpx does it
            assert attempt(url, keys, ca_file="root.pem", network=network, **ours) == (True, "answered 200")
            taken = len(heard)
            assert not attempt(url, keys, ca_file="other.pem", network=network, **ours)[0]
            assert not attempt(url, keys, network=network, **ours)[0]
            assert not attempt(url, keys, ca_file="root.pem", network=network)[0]
            wrong = f"https://wrong.example:{port}/x"
            assert not attempt(wrong, keys, ca_file="root.pem", network=network, **ours)[0]
            assert len(heard) == taken


@pytest.mark.parametrize(
    "wrong",
    [
        {"url": "http://a", "ca_file": "x"},
        {"url": "https://a", "key_file": "x"},
    ],
)
def test_certificates_that_would_not_be_used_are_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(ValidationError):
        ActionSettings.model_validate({"webhook": {"desk": wrong}})


def test_a_broker_and_a_server_are_held_to_the_rules_too(names: Names) -> None:
    names.addresses[NAME] = [["127.0.0.1"]]
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        broker = {"host": NAME, "port": port}
        client = create_mqtt_client(BrokerSettings(**broker, network=NetworkSettings(**PUBLIC_ONLY)), Path(), "a")
        with pytest.raises(PermissionError, match="refuses"):
            client.connect(NAME, port)
        settings = BrokerSettings(**broker, network=NetworkSettings(**LOOPBACK_TOO))
        client = create_mqtt_client(settings, Path(), "a")
        client.connect(NAME, port)
        listening.accept()[0].close()
        client.disconnect()

        async def connect(network: dict[str, Any]) -> None:
            server = {"kind": "opcua", "url": f"opc.tcp://{NAME}:{port}", "heartbeat_s": 1.0, "network": network}
            one = await create_opcua_client(OpcuaSourceSettings.model_validate(server), None, Path())
            await one.connect_socket()
            one.disconnect_socket()

        with pytest.raises(PermissionError, match="refuses"):
            asyncio.run(connect(PUBLIC_ONLY))
        asyncio.run(connect(LOOPBACK_TOO))


def test_the_section_holds_for_all_that_have_no_rules_of_their_own(tmp_path: Path) -> None:
    more = """
    [network]
    internal = false
    [sources.cell]
    kind = "opcua"
    url = "opc.tcp://localhost:4840"
    [sources.bus]
    kind = "mqtt"
    host = "localhost"
    network = { internal = false, allowed = ["10.0.0.0/8"] }
    [outlets.wall]
    kind = "mqtt"
    host = "localhost"
    [actions.webhook.desk]
    url = "http://localhost"
    [actions.mqtt.bell]
    broker = { host = "localhost" }
    topic = "bell"
    """
    found = ServiceFile.load(halls.hall(tmp_path, "hall", more=more))
    held: list[Any] = [found.sources["cell"], found.outlets["wall"], found.actions.webhook["desk"]]
    held.append(found.actions.mqtt["bell"].broker)
    assert all(one.rules == NetworkSettings(**PUBLIC_ONLY) for one in held)
    assert found.sources["bus"].rules.allowed == ("10.0.0.0/8",)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"network.*internal = false, add it"):
        ServiceFile.load(halls.hall(tmp_path, "wrong", more='[network]\nallowed = ["10.0.0.0/8"]\n'))


def test_the_files_of_a_broker_of_an_action_lie_beside_the_service_file(tmp_path: Path) -> None:
    message = {"broker": {"host": "a", "user": "u", "password_file": "p", "ca_file": "c"}, "topic": "t"}
    settings = ActionSettings.model_validate({"mqtt": {"bell": message}})
    row = OutboxEntry("0", "bell", {"event": "occur"}, created=time.time(), due=0.0)
    assert str(tmp_path / "p") in deliver(row, settings, time.time(), tmp_path).detail
    (tmp_path / "p").write_text("hush")
    assert "certificates are given" in deliver(row, settings, time.time(), tmp_path).detail
    with pytest.raises(ConfigError, match="certificates cannot be used"):
        settings.mqtt["bell"].broker.create_tls_context(tmp_path, "a")


@pytest.mark.parametrize(
    ("section", "said", "rules"),
    [
        ('[network]\nrefused = ["internal"]', "internal = false", {"internal": False}),
        (
            '[network]\nrefused = ["::/0"]\nallowed = ["10.2.0.7"]',
            "firewall",
            {"internal": False, "allowed": ("10.2.0.7",)},
        ),
        ("[network]\nrefused = []", "internal = false", {}),
        ('[store.network]\nrefused = ["internal"]', "sslmode=verify-full", {}),
    ],
)
def test_keys_of_earlier_versions_are_read_with_a_warning_and_refused_by_check(
    section: str, said: str, rules: dict[str, Any], tmp_path: Path
) -> None:
    path = halls.hall(tmp_path, "hall", more=section)
    with pytest.warns(ObsoleteSettingWarning, match=said):
        assert ServiceFile.load(path).network == NetworkSettings(**rules)
    refused = CliRunner().invoke(app, ["run", str(path), "--check"])
    assert refused.exit_code == 1 and said in refused.output and len(refused.output.splitlines()) == 1
