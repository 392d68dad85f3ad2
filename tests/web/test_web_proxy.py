"""The pages behind `deploy/nginx.conf`, with nginx itself: what passes, what does not, and whose address counts."""

from __future__ import annotations

import re
import ssl
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from brokers import until
from browsing import Served, login
from reliability.servers import server_program
from reliability.workplace import free_port

from servoscope.service.access import Users

NGINX = server_program("nginx")
PASSWORD = "a long password of hers"
FRAME = """
daemon off;
pid nginx.pid;
error_log stderr;
events {{}}
http {{
    access_log off;
    client_body_temp_path bodies;
    proxy_temp_path answers;
    fastcgi_temp_path fastcgi;
    uwsgi_temp_path uwsgi;
    scgi_temp_path scgi;
{site}
}}
"""


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory, project: Path) -> Iterator[httpx.Client]:
    """Return a client of nginx, which runs the file of `deploy/` with other ports and a certificate of its own."""
    if NGINX is None:
        pytest.skip("nginx is not on this machine: scripts/install-test-servers installs it")
    folder = tmp_path_factory.mktemp("proxy")
    Users(folder / "users.json").add("vera", "viewer", PASSWORD)
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=monitor.example -addext subjectAltName=DNS:localhost"
    files = ("-keyout", folder / "monitor.example.key", "-out", folder / "monitor.example.pem")
    subprocess.run(["openssl", *words.split(), *files], check=True, capture_output=True)
    site = (project / "deploy/nginx.conf").read_text()
    (settings,) = re.findall(r"^#   (\[web\]\n(?:#   .+\n)+)", site, flags=re.MULTILINE)
    text = 'name = "hall"\n[sources.s]\nkind = "replay"\n[assets.a]\nbaseline = "b"\nsource = "s"\nfiles = ["f"]\n'
    (folder / "hall.toml").write_text(text + settings.replace("#   ", "").replace(":8080", ":0"))
    with Served(folder, "serve", "hall.toml") as served:
        port = free_port()
        for before, after in (
            ("127.0.0.1:8080", urlsplit(served.url).netloc),
            ("listen 443", f"listen 127.0.0.1:{port}"),
        ):
            assert before in site
            site = site.replace(before, after)
        site, certificates = re.subn(r"/\S+/(monitor\.example\.\w+)", rf"{folder}/\1", site)
        assert certificates == 2
        (folder / "nginx.conf").write_text(FRAME.format(site=site))
        process = subprocess.Popen([NGINX, "-p", f"{folder}/", "-c", "nginx.conf", "-e", "stderr"])
        trusted = ssl.create_default_context(cafile=str(folder / "monitor.example.pem"))
        try:
            with httpx.Client(base_url=f"https://localhost:{port}", verify=trusted, timeout=60.0) as client:
                until(lambda: _answers(client), 30.0)
                yield client
        finally:
            process.terminate()
            process.wait(30)


def _answers(client: httpx.Client) -> bool:
    try:
        return client.get("/").status_code == 200
    except httpx.ConnectError:
        return False


def test_a_login_passes_and_its_cookie_is_for_encrypted_connections(proxy: httpx.Client) -> None:
    assert proxy.get("/api/v1/assets").status_code == 401
    page = {"Origin": str(proxy.base_url).rstrip("/"), "Sec-Fetch-Site": "same-origin"}
    said = proxy.post("/api/v1/session", json={"user": "vera", "password": PASSWORD}, headers=page)
    assert said.status_code == 200 and "Secure" in said.headers["set-cookie"]
    assert proxy.get("/api/v1/assets").json()["assets"] == []
    assert proxy.get("/").headers["strict-transport-security"] == "max-age=31536000"
    with proxy.stream("GET", "/api/v1/live") as stream:  # events are not kept until there are more of them
        assert next(stream.iter_lines()).startswith("retry")


@pytest.mark.parametrize("path", ["/metrics", "/health/live"])
def test_what_is_for_this_machine_alone_does_not_pass(proxy: httpx.Client, path: str) -> None:
    assert proxy.get(path).status_code == 404


def test_a_name_or_an_origin_of_others_is_refused(proxy: httpx.Client) -> None:
    assert proxy.get("/api/v1/session", headers={"Host": "evil.example"}).status_code == 421
    assert proxy.get("/api/v1/session", headers={"Origin": "https://evil.example"}).status_code == 403


def test_an_address_that_a_client_has_made_up_does_not_count(proxy: httpx.Client) -> None:
    with httpx.Client(base_url=f"{proxy.base_url}/api/v1", verify=False) as client:
        answers = []
        for k in range(6):
            client.headers["X-Forwarded-For"] = f"198.51.100.{k}"
            answers.append(login(client, f"nobody-{k}", "a wrong password").status_code)
    assert answers == [401] * 5 + [429]
