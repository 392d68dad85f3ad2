"""Users whom a proxy signs in: by its headers alone, and by Apache with a provider of OpenID Connect in front."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import ssl
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import pytest
from brokers import until
from browsing import Served
from commands import one_line, run
from oidc_provider import SECRET, provider, sign_in
from pages_context import open_context
from reliability.servers import server_program
from reliability.workplace import free_port

from servoscope.service.access import Users, WebSettings
from servoscope.service.store import Store
from servoscope.web.app import create_app

APACHE, MODULES = server_program("apache2"), Path(os.sep, "usr", "lib", "apache2", "modules")
PASSWORD = "a long password of hers"
PROXY_SECRET = "hush of the proxy"
ROLES = {"viewer": ["works"], "operator": ["shift-leaders"], "engineer": ["maintenance"]}
OTTO = {"X-Forwarded-User": "otto", "X-Forwarded-Groups": "canteen, shift-leaders,works"}
SIGNED = {"X-Proxy-Secret": PROXY_SECRET, **OTTO}


def ask(folder: Path, *requests: tuple[str, str, Any], on_socket: bool = False) -> list[httpx.Response]:
    """Send requests (method, path, headers) to an application behind a proxy."""
    listen, secret = ("unix:web.sock", {}) if on_socket else ("127.0.0.1:0", {"secret_env": "PROXY_SECRET"})
    plain = {"listen": listen, "users": "users.json", "sign_on": {"roles": ROLES, **secret}}
    users, expected = Users(folder / "users.json"), None if on_socket else PROXY_SECRET.encode()
    users.add("vera", "viewer", PASSWORD)

    async def browse(app: Any) -> list[httpx.Response]:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
            return [await client.request(method, f"/api/v1{path}", headers=more) for method, path, more in requests]

    with open_context(folder, WebSettings.model_validate(plain), users, proxy_secret=expected) as context:
        return asyncio.run(browse(create_app(context)))


def test_the_proxy_names_the_user_and_the_highest_role_of_its_groups_counts(tmp_path: Path) -> None:
    session, assets, upload = ask(
        tmp_path, ("GET", "/session", SIGNED), ("GET", "/assets", SIGNED), ("POST", "/baselines", SIGNED)
    )
    shown = session.json()
    assert (shown["user"], shown["role"], shown["csrf"]) == ("otto", "operator", None)
    assert assets.status_code == 200
    assert upload.status_code == 403 and "needs engineer" in upload.json()["detail"]


def test_over_a_unix_socket_the_headers_need_no_secret(tmp_path: Path) -> None:
    (session,) = ask(tmp_path, ("GET", "/session", OTTO), on_socket=True)
    assert session.json()["user"] == "otto"


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        (OTTO, "X-Proxy-Secret"),
        ({**SIGNED, "X-Proxy-Secret": "guess"}, "X-Proxy-Secret"),
        ({**SIGNED, "X-Proxy-Secret": ""}, "X-Proxy-Secret"),
        ({**SIGNED, "X-Forwarded-User": "<script>"}, "no name of a user"),
        ({**SIGNED, "X-Forwarded-User": ""}, "no name of a user"),
        ([*SIGNED.items(), ("X-Forwarded-User", "enno")], "no name of a user"),
        ([*SIGNED.items(), ("X-Proxy-Secret", PROXY_SECRET)], "X-Proxy-Secret"),
        ({**SIGNED, "X-Forwarded-Groups": "canteen"}, "has no role here"),
        ({**SIGNED, "X-Forwarded-Groups": "maintenance-of-cars"}, "has no role here"),
    ],
)
def test_headers_that_prove_nothing_are_refused_with_their_reason(tmp_path: Path, headers: Any, why: str) -> None:
    for answer in ask(tmp_path, ("GET", "/assets", headers), ("GET", "/session", headers)):
        assert answer.status_code == 403 and why in answer.json()["detail"]
        assert PROXY_SECRET not in answer.text


def test_whom_the_proxy_does_not_name_has_to_log_in(tmp_path: Path) -> None:
    session, assets = ask(tmp_path, ("GET", "/session", {}), ("GET", "/assets", {"X-Proxy-Secret": PROXY_SECRET}))
    assert session.json()["user"] is None and session.json()["password_login"]
    assert assets.status_code == 401


def test_a_page_of_others_cannot_use_the_proxys_sign_on(tmp_path: Path) -> None:
    foreign = {**SIGNED, "Origin": "https://evil.example"}, {**SIGNED, "Sec-Fetch-Site": "cross-site"}
    answers = ask(tmp_path, *(("POST", "/uploads", headers) for headers in foreign))
    assert [answer.status_code for answer in answers] == [403, 403]


SERVICE = """name = "hall"
[sources.s]
kind = "replay"
[assets.a]
baseline = "b"
source = "s"
files = ["f"]
[store]
url = "history.sqlite"
[web]
"""
WRONG = {
    "headers that anybody could write": ('[web.sign_on]\nroles.viewer = ["works"]', "secret_env"),
    "no secret": ('[web.sign_on]\nroles.viewer = ["works"]\nsecret_env = "SURELY_NOT_SET"', "SURELY_NOT_SET"),
    "a role": ('[web.sign_on]\nroles.admin = ["works"]\nsecret_env = "A"', "admin"),
    "no role": ('[web.sign_on]\nroles = {}\nsecret_env = "A"', "roles"),
    "a header": ('[web.sign_on]\nroles.viewer = ["works"]\nsecret_env = "A"\nuser_header = "a b"', "no header"),
    "TLS on a socket": ('listen = "unix:web.sock"\ncertificate = "a"\nkey = "b"', "certificate"),
    "a socket nowhere": ('listen = "unix:none/web.sock"', "another path"),
    "single sign-on of 1.0": ('[web.oidc]\nissuer = "https://id.example"', "[web.sign_on]"),
    "its key": ("password_login = false", "leave it out"),
}


@pytest.mark.parametrize("case", WRONG)
def test_settings_that_are_wrong_are_one_line_with_the_remedy(case: str, tmp_path: Path) -> None:
    web, word = WRONG[case]
    (tmp_path / "hall.toml").write_text(SERVICE + web)
    Store.open("history.sqlite", tmp_path, write=True).close()
    one_line(run("serve", tmp_path / "hall.toml"), word)


FRAME = """
ServerRoot {folder}
ServerName monitor.example
DefaultRuntimeDir {folder}
PidFile apache.pid
{user}
ErrorLog apache.log
{modules}
{site}
"""
NEEDED = "mpm_event", "unixd", "authn_core", "authz_core", "authz_user", "ssl", "headers", "proxy", "proxy_http"


@pytest.fixture(scope="module")
def signed_on(project: Path) -> Iterator[tuple[str, ssl.SSLContext]]:
    """Run the pages on a Unix socket behind Apache, with the file of `deploy/`, and a provider; yield its address."""
    if APACHE is None or not (MODULES / "mod_auth_openidc.so").exists():
        pytest.skip("apache2 or mod_auth_openidc is not on this machine: scripts/install-test-servers installs them")
    with TemporaryDirectory() as folder:
        yield from _serve_behind_apache(Path(folder), free_port(), project)


def _serve_behind_apache(folder: Path, port: int, project: Path) -> Iterator[tuple[str, ssl.SSLContext]]:
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=monitor.example -addext subjectAltName=DNS:localhost"
    files = ("-keyout", folder / "monitor.example.key", "-out", folder / "monitor.example.pem")
    subprocess.run(["openssl", *words.split(), *files], check=True, capture_output=True)
    (folder / "client-secret.conf").write_text(f"OIDCClientSecret {SECRET}\n")
    (folder / "cookie.secret").write_text("of the cookies of this test")
    site = (project / "deploy/apache-oidc.conf").read_text()
    described = [line.removeprefix("#   ") for line in site.splitlines() if line.startswith("#   ")]
    settings = "\n".join(described[described.index("[web]") + 1 :]).replace("/run/servoscope/", f"{folder}/")
    (folder / "hall.toml").write_text(SERVICE + settings)
    users = (
        {"sub": "7", "preferred_username": "otto", "groups": ["works", "shift-leaders"]},
        {"sub": "8", "preferred_username": "nobody", "groups": ["canteen"]},
    )
    with (
        Served(folder, "serve", "hall.toml") as served,
        provider(f"https://localhost:{port}/signed-on", *users) as issuer,
    ):
        assert served.url == f"unix:{folder}/web.sock"
        assert stat.S_IMODE((folder / "web.sock").stat().st_mode) == 0o660
        for before, after in (
            ("*:443", f"127.0.0.1:{port}"),
            ("https://id.example", issuer),
            ("https://monitor.example/", f"https://localhost:{port}/"),
        ):
            assert before in site
            site = site.replace(before, after)
        site, moved = re.subn(r"/\S+/([\w.-]+\.(?:pem|key|conf|secret|sock))\b", rf"{folder}/\1", site)
        assert moved == 7  # two of them in comments
        loaded = [*((name, f"mod_{name}.so") for name in NEEDED), ("auth_openidc", "mod_auth_openidc.so")]
        modules = "\n".join(
            f"LoadModule {name}_module {MODULES / file}" for name, file in loaded if (MODULES / file).exists()
        )
        user = ""
        if os.geteuid() == 0:  # Apache gives root up, and needs a way to the socket
            user = "User www-data\nGroup www-data"
            shutil.chown(folder / "web.sock", group="www-data")
            folder.chmod(0o711)
        text = FRAME.format(folder=folder, user=user, modules=f"{modules}\nListen 127.0.0.1:{port}", site=site)
        (folder / "apache.conf").write_text(text)
        process = subprocess.Popen([APACHE, "-d", folder, "-f", folder / "apache.conf", "-D", "FOREGROUND"])
        trusted = ssl.create_default_context(cafile=str(folder / "monitor.example.pem"))
        address = f"https://localhost:{port}"
        try:
            until(lambda: _answers(address, trusted), 30.0)
            yield address, trusted
        finally:
            process.terminate()
            process.wait(30)


def _answers(address: str, trusted: ssl.SSLContext) -> bool:
    try:
        return httpx.get(f"{address}/health/live", verify=trusted).status_code < 500
    except httpx.ConnectError:
        return False


def test_a_user_signs_in_at_the_provider_and_comes_back_to_the_page(signed_on: tuple[str, ssl.SSLContext]) -> None:
    address, trusted = signed_on
    forged = {"X-Forwarded-User": "enno", "X-Forwarded-Groups": "maintenance"}
    with httpx.Client(base_url=address, verify=trusted, timeout=60.0) as browser:
        behind = browser.get("/api/v1/assets", headers={"Sec-Fetch-Mode": "cors", **forged})
        assert behind.status_code == 401  # the page asks to sign in again
        page = sign_in(browser, "/alarms", "7")
        assert (page.status_code, page.url.path) == (200, "/alarms")
        session = browser.get("/api/v1/session", headers=forged).json()
        assert (session["user"], session["role"]) == ("otto", "operator")
        assert browser.get("/api/v1/assets", headers=forged).json()["assets"] == []
        for path in ("/metrics", "/health/live"):  # for this machine alone
            assert browser.get(path).status_code == 404
    with httpx.Client(base_url=address, verify=trusted, timeout=60.0) as browser:
        sign_in(browser, "/", "8")
        answer = browser.get("/api/v1/assets")
        assert answer.status_code == 403 and "nobody has no role here" in answer.json()["detail"]
