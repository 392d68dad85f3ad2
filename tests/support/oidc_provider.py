"""A provider of OpenID Connect as a process: oidc-provider, which the OpenID Foundation has certified."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

SECRET = "hush0-of-the-client"
SERVER = Path(__file__).with_name("oidc_server") / "provider.mjs"


@contextmanager
def provider(callback: str, *users: dict[str, Any]) -> Iterator[str]:
    """Run a provider that knows these users and one client; yield its address."""
    command = [found_node(SERVER), str(SERVER), json.dumps(users), SECRET, callback]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.stdout.close()
        process.wait(10)


def found_node(server: Path) -> str:
    """Return Node.js; skip the test without it or the packages of a server."""
    node = shutil.which("node")
    if node is None or not server.with_name("node_modules").is_dir():
        pytest.skip(f"{server.parent.name} is not installed: scripts/install-test-servers installs it")
    return node


def sign_in(browser: httpx.Client, page: str, sub: str) -> httpx.Response:
    """Ask for a page, and fill in the provider's forms (name, then consent) until the page comes."""
    answer = browser.get(page)
    for form in ({"prompt": "login", "login": sub, "password": "any"}, {"prompt": "consent"}):
        while answer.is_redirect:
            answer = browser.get(str(answer.next_request.url))  # type: ignore[union-attr]
        answer = browser.post(answer.url, data=form)
    while answer.is_redirect:
        answer = browser.get(str(answer.next_request.url))  # type: ignore[union-attr]
    return answer
