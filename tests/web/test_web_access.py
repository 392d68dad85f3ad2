"""Who may do what: hosts and origins, users and roles, logins, tokens; what a foreign page can make a browser send."""

from __future__ import annotations

import http.client
import json
import shutil
import ssl
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import halls
import httpx
import pytest
from browsing import Served, login, upload
from commands import run
from halls import hall

from servoscope.core.errors import AccessError, ConfigError
from servoscope.service.access import AllowedHosts, LoginThrottle, Sessions, Users, WebSettings
from servoscope.service.build import build_components
from servoscope.service.config import ServiceFile
from servoscope.service.service import Service

PASSWORDS = {"vera": "a long password of hers", "otto": "a long password of his", "enno": "one more long password"}
ROLES = {"vera": "viewer", "otto": "operator", "enno": "engineer"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store that a service has left, and a file of users."""
    made = tmp_path_factory.mktemp("access")
    halls.files(made)
    config = ServiceFile.load(hall(made, "done"))
    Service(config, build_components(config)).run()
    users = Users(made / "users.json")
    for name, role in ROLES.items():
        users.add(name, role, PASSWORDS[name])  # type: ignore[arg-type]
    return made


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Served]:
    options = ("--store", "done.sqlite", "--users", "users.json", "--host", "monitor.example")
    with Served(folder, "serve", *options, "--listen", "127.0.0.1:0") as served:
        yield served


@pytest.fixture(scope="module")
def clients(server: Served) -> Iterator[dict[str, httpx.Client]]:
    found = {name: server.client() for name in ROLES}
    for name, client in found.items():
        assert login(client, name, PASSWORDS[name]).json()["role"] == ROLES[name]
    yield found
    for client in found.values():
        client.close()


@pytest.mark.parametrize("path", ["/assets", "/live", "/openapi.json", "/uploads", "/diagnoses/press@1/report"])
def test_without_login_nothing_is_told(server: Served, path: str) -> None:
    with server.client() as client:
        said = client.get(path)
        assert said.status_code == 401 and said.headers["content-type"] == "application/problem+json"
        assert client.get("/session").json() | {"version": ""} == {
            "login_required": True,
            "password_login": True,
            "single_sign_on": None,
            "user": None,
            "role": None,
            "csrf": None,
            "expires": None,
            "version": "",
        }
        assert httpx.get(f"{server.url}/metrics").status_code == 401


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(server: Served) -> None:
    with server.client() as client:
        cookie = login(client, "vera", PASSWORDS["vera"]).headers["set-cookie"]
        assert "HttpOnly" in cookie and "SameSite=strict" in cookie and "Path=/" in cookie and "Domain" not in cookie
        assert client.get("/assets").status_code == 200
        assert client.delete("/session").status_code == 204
        assert client.get("/assets").status_code == 401
        forged = client.get("/assets", headers={"Cookie": cookie.split(";")[0]})
        assert forged.status_code == 401  # it ended at the server too


ACTIONS = {
    "see": ("GET", "/assets", None),
    "see the audit": ("GET", "/audit", None),
    "acknowledge": ("POST", "/assets/nobody/alarms/fault/acknowledge", {}),
    "inspect": ("POST", "/inspections", {"upload": "0"}),
    "diagnose": ("POST", "/diagnoses", {"upload": "0", "baseline": "0"}),
    "learn": ("POST", "/learnings", {"loop": {"example": "reference-rig"}, "recordings": [{"upload": "0"}]}),
    "save": ("POST", "/baselines", {"name": "x", "learning": "0"}),
    "delete a baseline": ("DELETE", "/baselines/x", None),
    "design": ("POST", "/designs", {"loop": {"baseline": "0"}}),
}


@pytest.mark.parametrize(
    ("who", "may"),
    [
        ("vera", {"see"}),
        ("otto", {"see", "see the audit", "acknowledge", "inspect", "diagnose"}),
        ("enno", set(ACTIONS)),
    ],
)
def test_roles(clients: dict[str, httpx.Client], who: str, may: set[str]) -> None:
    allowed = set()
    for name, (method, path, body) in ACTIONS.items():
        said = clients[who].request(method, path, **({"json": body} if body is not None else {}))
        assert said.status_code in (200, 403, 404), said.text
        allowed |= {name} if said.status_code != 403 else set()
    assert allowed == may
    assert (upload(clients[who], "x.csv", b"t,r,u,y\n1,2,3,4\n").status_code == 403) == (who == "vera")


def test_what_changes_something_needs_the_token(server: Served) -> None:
    with server.client() as client:
        login(client, "otto", PASSWORDS["otto"])
        path, token = "/assets/nobody/alarms/fault/acknowledge", client.headers.pop("X-CSRF-Token")
        for headers in ({}, {"X-CSRF-Token": "0"}, {"X-CSRF-Token": token[:-1]}):
            assert client.post(path, json={}, headers=headers).status_code == 403
        assert client.delete("/uploads/0").status_code == 403
        assert client.post(path, json={}, headers={"X-CSRF-Token": token}).status_code == 404
        # a form of a foreign page can send this kind, without asking the server first
        plain = {"X-CSRF-Token": token, "Content-Type": "text/plain"}
        assert client.post(path, content=b"{}", headers=plain).status_code == 422


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),  # what DNS rebinding looks like
        ({"Host": "localhost.evil.example"}, 421),
        ({"Host": "127.0.0.1@evil.example"}, 421),
        ({"Host": ""}, 421),
        ({"Host": "monitor.example"}, 200),
        ({"Host": "MONITOR.example.:443"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),  # another server of this machine is foreign too
        ({"Host": "monitor.example", "Origin": "https://monitor.example"}, 200),  # behind a proxy that ends TLS
        ({"Host": "monitor.example", "Origin": "http://monitor.example.evil.example"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}, 200),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "same-origin"}, 200),
    ],
)
@pytest.mark.parametrize("path", ["/session", "/live"])
def test_foreign_pages_and_names_are_refused(
    clients: dict[str, httpx.Client], path: str, headers: dict[str, str], status: int
) -> None:
    with clients["enno"].stream("GET", path, headers=headers) as said:
        assert said.status_code == status


def test_a_host_that_comes_twice_is_refused(server: Served) -> None:
    connection = http.client.HTTPConnection(urlsplit(server.url).netloc)
    connection.putrequest("GET", "/api/v1/session", skip_host=True)
    for host in ("localhost", "evil.example"):
        connection.putheader("Host", host)
    connection.endheaders()
    assert connection.getresponse().status in (400, 421)
    connection.close()


def test_no_web_socket_is_opened(server: Served) -> None:
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    said = httpx.get(f"{server.url}/api/v1/live", headers={**upgrade, "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="})
    assert said.status_code in (401, 403)


def test_the_same_holds_on_loopback_without_login(folder: Path) -> None:
    with Served(folder, "serve", "--store", "done.sqlite", "--listen", "127.0.0.1:0") as served:
        assert "no login" in served.said
        with served.client() as client:
            assert client.get("/assets").status_code == 200
            assert client.get("/assets", headers={"Host": "evil.example"}).status_code == 421
            assert client.get("/assets", headers={"Origin": "http://evil.example"}).status_code == 403
            said = client.post("/assets/press/alarms/fault/acknowledge", json={}, headers={"Origin": "null"})
            assert said.status_code == 403
            # nobody follows the assets: what was asked for waits for the service
            said = client.post("/assets/press/alarms/fault/acknowledge", json={})
            assert said.status_code == 202 and said.json()["outcome"] is None


@pytest.mark.parametrize("empty", [None, "# nothing yet\n"])
def test_it_starts_with_nothing(tmp_path: Path, empty: str | None) -> None:
    if empty is not None:
        (tmp_path / "hall.toml").write_text(empty)
    given = () if empty is None else ("hall.toml",)
    with Served(tmp_path, "serve", *given, "--listen", "127.0.0.1:0") as served, served.client() as client:
        assert client.get("/assets").json()["assets"] == []
    assert (tmp_path / "history.sqlite").exists()


def test_with_tls_the_cookie_is_bound_to_the_host(folder: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not on this machine")
    make = "openssl req -x509 -newkey rsa:2048 -nodes -keyout key.pem -out cert.pem -days 2 -subj /CN=localhost"
    subprocess.run(make.split(), cwd=folder, check=True, capture_output=True)
    options = ("--store", "done.sqlite", "--users", "users.json", "--certificate", "cert.pem", "--key", "key.pem")
    trusted = ssl.create_default_context(cafile=str(folder / "cert.pem"))
    trusted.check_hostname = False
    with Served(folder, "serve", *options, "--listen", "127.0.0.1:0") as served:
        assert served.url.startswith("https://")
        with served.client(verify=trusted) as client:
            said = login(client, "vera", PASSWORDS["vera"])
            assert (
                said.headers["set-cookie"].startswith("__Host-servoscope=") and "Secure" in said.headers["set-cookie"]
            )
            assert "strict-transport-security" in said.headers
            assert client.get("/assets", headers={"Origin": served.url}).status_code == 200


def test_a_removed_user_is_out_at_once_and_streams_end(server: Served, folder: Path) -> None:
    users = Users(folder / "users.json")
    users.add("gone", "viewer", "will not last for long")
    with server.client() as client:
        login(client, "gone", "will not last for long")
        with client.stream("GET", "/live") as stream:
            lines = stream.iter_lines()
            next(lines)
            users.add("gone", "viewer", "another password now")
            assert client.get("/assets").status_code == 401


def test_failed_logins_are_slowed_down_and_told(folder: Path) -> None:
    options = ("--store", "done.sqlite", "--users", "users.json", "--listen", "127.0.0.1:0")
    with Served(folder, "serve", *options) as served, served.client() as client:
        answers = [login(client, "vera", "wrong").status_code for _ in range(6)]
        assert answers == [401] * 5 + [429]
        said = login(client, "vera", PASSWORDS["vera"])
        assert said.status_code == 429 and 0 < int(said.headers["retry-after"]) <= 61
    with Served(folder, "serve", *options) as served, served.client() as client:
        login(client, "enno", PASSWORDS["enno"])
        entries = client.get("/audit").json()["entries"]
        assert [one["what"] for one in entries if one["who"] == "vera"][-5:] == ["login refused"] * 5


@pytest.mark.parametrize(("listen", "heeded"), [("127.0.0.1:0", True), ("0.0.0.0:0", False)])
def test_browsers_are_told_nothing_that_they_only_complain_of(folder: Path, listen: str, heeded: bool) -> None:
    with Served(folder, "serve", "--store", "done.sqlite", "--users", "users.json", "--listen", listen) as served:
        headers = httpx.get(f"{served.url}/login").headers
        assert ("cross-origin-opener-policy" in headers) is heeded and "content-security-policy" in headers


class TestHosts:
    def test_a_numeric_address_cannot_be_rebound(self) -> None:
        everywhere = AllowedHosts.of("0.0.0.0:8080", ["monitor.example"])
        assert everywhere.known("192.0.2.7:8080") and everywhere.known("[2001:db8::1]:8080")
        assert everywhere.known("monitor.example") and not everywhere.known("evil.example")
        assert not AllowedHosts.of("127.0.0.1:8080", []).known("192.0.2.7:8080")

    @pytest.mark.parametrize("origin", ["", "null", "http://", "ftp://localhost", "http://localhost:x", "localhost"])
    def test_what_is_no_origin_is_foreign(self, origin: str) -> None:
        assert not AllowedHosts.same(origin, "localhost", "http")

    def test_default_ports_may_be_left_out(self) -> None:
        assert AllowedHosts.same("http://localhost:80", "localhost", "http")
        assert not AllowedHosts.same("http://localhost:8080", "localhost", "http")


class TestUsers:
    def test_the_file_is_for_its_owner_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "users.json"
        users = Users(path)
        users.add("vera", "viewer", "a long password")
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert "a long password" not in path.read_text() and "$argon2id$" in path.read_text()
        assert users.check("vera", "a long password") == "viewer"
        assert users.check("vera", "another password") is None and users.check("nobody", "a long password") is None
        path.chmod(0o640)
        with pytest.raises(AccessError, match="chmod 600"):
            Users(path).all()

    @pytest.mark.parametrize(
        ("name", "password"), [("", "a long password"), ("a/b", "a long password"), ("vera", "short")]
    )
    def test_names_and_passwords_that_will_not_do(self, tmp_path: Path, name: str, password: str) -> None:
        with pytest.raises(AccessError):
            Users(tmp_path / "users.json").add(name, "viewer", password)

    @pytest.mark.parametrize("text", ["", "{}", '{"version": 1, "users": {"a": {"role": "root", "password": ""}}}'])
    def test_a_file_that_is_none_is_refused(self, tmp_path: Path, text: str) -> None:
        path = tmp_path / "users.json"
        path.touch(mode=0o600)
        path.write_text(text)
        with pytest.raises(AccessError):
            Users(path).all()

    def test_the_commands(self, tmp_path: Path) -> None:
        file = ("--users", tmp_path / "users.json")
        done = run("users", "add", "vera", "--role", "operator", "--password-stdin", *file, input="a long password\n")
        assert done.code == 0, done.err
        assert json.loads(run("users", "list", "--json", *file).out) == {"vera": "operator"}
        assert run("users", "add", "otto", "--role", "root", "--password-stdin", *file, input="x\n").code == 2
        assert run("users", "remove", "vera", *file).code == 0
        assert run("users", "remove", "vera", *file).code == 1


class TestSettings:
    @pytest.mark.parametrize(
        "wrong",
        [
            {"listen": "0.0.0.0:8080"},
            {"hosts": ("monitor.example",)},
            {"listen": "127.0.0.1:99999"},
            {"certificate": "a.pem"},
            {"job_memory_mb": 10.0},
        ],
    )
    def test_what_is_not_safe_is_refused(self, wrong: dict[str, object]) -> None:
        with pytest.raises(ValueError):
            WebSettings.model_validate(wrong)

    def test_others_need_users(self, tmp_path: Path) -> None:
        done = run("serve", "--store", tmp_path / "new.sqlite", "--listen", "0.0.0.0:0")
        assert done.code == 1 and "[web] users: missing" in done.err
        done = run("serve", "--store", tmp_path / "new.sqlite", "--listen", "127.0.0.1:0", "--users", "none.json")
        assert done.code == 1 and "none.json: no such file, add one" in done.err

    def test_a_path_of_the_command_line_is_relative_to_where_it_is_said(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "there").mkdir()
        (tmp_path / "here").mkdir()
        path = hall(tmp_path / "there", "x")
        monkeypatch.chdir(tmp_path / "here")
        done = run("serve", path, "--users", "users.json")
        assert done.code == 1 and f"{tmp_path / 'here' / 'users.json'}: no such file" in done.err

    def test_the_section_is_part_of_the_service_file(self, tmp_path: Path) -> None:
        path = hall(tmp_path, "x", more='[web]\nlisten = "0.0.0.0:80"\n')
        with pytest.raises(ConfigError, match="web: users: missing"):
            ServiceFile.load(path)


def test_sessions_end_and_attempts_are_forgotten() -> None:
    sessions = Sessions(10.0)
    secret, session = sessions.begin("vera", "s", 0.0)
    assert sessions.find(secret, 9.9) == session and sessions.find(secret, 10.0) is None
    assert sessions.find("another", 1.0) is None and sessions.find(None, 1.0) is None
    attempts = LoginThrottle(2, 60.0)
    attempts.reserve(["a"], 0.0)
    attempts.settle(["a"], 0.0, failed=True)
    assert attempts.reserve(["a"], 10.0) == 0.0
    assert attempts.reserve(["b", "a"], 10.0) > 0.0 == attempts.wait("b", 10.0)  # the other is being checked
    attempts.settle(["a"], 10.0, failed=True)
    assert attempts.wait("a", 20.0) == 40.0 and attempts.wait("b", 20.0) == 0.0
    assert attempts.wait("a", 61.0) == 0.0
