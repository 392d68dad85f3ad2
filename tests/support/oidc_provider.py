"""Providers of OpenID Connect as processes: oidc-provider-mock, which also checks the verifier (RFC 7636) here, and
oidc-provider, which the OpenID Foundation has certified."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
import warnings
from base64 import b64decode, urlsafe_b64encode
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import parse_qs, unquote_plus, urlsplit

import pytest

from servoscope.service.access.oidc import CALLBACK

SECRET = "hush0 of the client"
ADDRESS = "http://localhost:8080"  # of the pages
SERVER = Path(__file__).with_name("oidc_server") / "provider.mjs"


class Provider:
    """The provider; a context manager."""

    def __init__(self, *users: dict[str, Any]) -> None:
        self._users, self.url = users, ""

    def __enter__(self) -> Provider:
        self._process = subprocess.Popen(self._command(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().strip()
        return self

    def _command(self) -> list[str]:
        return [sys.executable, __file__, json.dumps(self._users)]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process.wait(10)


class CertifiedProvider(Provider):
    """A provider whose ID tokens hold what the standard demands, and no names and groups."""

    def _command(self) -> list[str]:
        return [found_node(SERVER), str(SERVER), json.dumps(self._users), SECRET, ADDRESS + CALLBACK]


def found_node(server: Path) -> str:
    """Return Node.js; skip the test without it or the packages of a server."""
    node = shutil.which("node")
    if node is None or not server.with_name("node_modules").is_dir():
        pytest.skip(f"{server.parent.name} is not installed: scripts/install-test-servers installs it")
    return node


def _challenges(app: Any) -> Any:
    """Return an application that refuses codes without the verifier of their challenge, and clients without secret."""
    challenges: dict[str, str] = {}

    def wrapped(environ: dict[str, Any], start: Any) -> Any:
        path, query = environ["PATH_INFO"], parse_qs(environ.get("QUERY_STRING", ""))

        def begin(status: str, headers: list[tuple[str, str]], *more: Any) -> Any:
            for code in parse_qs(urlsplit(dict(headers).get("Location", "")).query).get("code", ()):
                assert query["code_challenge_method"] == ["S256"]
                challenges[code] = query["code_challenge"][0]
            return start(status, headers, *more)

        if path == "/oauth2/token":
            body = environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"]))
            environ["wsgi.input"] = io.BytesIO(body)
            form = parse_qs(body.decode())
            digest = sha256(form.get("code_verifier", [""])[0].encode()).digest()
            known = challenges.pop(form["code"][0], None) == urlsafe_b64encode(digest).rstrip(b"=").decode()
            basic = b64decode(environ.get("HTTP_AUTHORIZATION", "").removeprefix("Basic ")).decode()
            if not known or unquote_plus(basic) != f"hall:{SECRET}":
                start("400 Bad Request", [("Content-Type", "application/json")])
                return [b'{"error": "invalid_grant"}']
        return app(environ, begin)

    return wrapped


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    from oidc_provider_mock import app
    from oidc_provider_mock._storage import User
    from werkzeug.serving import make_server

    made = app(
        user_claims=[
            User(sub=one["sub"], claims={k: v for k, v in one.items() if k != "sub"}) for one in json.loads(sys.argv[1])
        ]
    )
    server = make_server("127.0.0.1", 0, _challenges(made.wsgi_app), threaded=True)
    print(f"http://127.0.0.1:{server.server_port}", flush=True)
    server.serve_forever()
