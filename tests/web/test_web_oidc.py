"""Single sign-on against a provider that runs beside the tests: who gets in, as what, and what does not pass."""

from __future__ import annotations

import asyncio
import importlib
import json
import re
import shutil
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from browsing import Served
from commands import one_line, run
from joserfc import jwt
from joserfc.jwk import KeySet, OctKey, RSAKey
from oidc_provider import ADDRESS, SECRET, CertifiedProvider, Provider
from oidc_steps import browse, confirm, confirm_by_forms, go_to_provider, log_in
from pages_context import open_context
from screens import BROWSERS

from servoscope.core.errors import ConfigError
from servoscope.service.access import Users, WebSettings
from servoscope.service.store import Store
from servoscope.web.dependencies import Context, SingleSignOn
from servoscope.web.oidc_client import OAuthError, OidcClient, ProviderError

PASSWORD = "a long password of hers"
ROLES = {"viewer": ["everybody"], "operator": ["shift"], "engineer": ["maintenance"]}
OTTO = {"sub": "7", "preferred_username": "otto", "groups": ["everybody", "shift"]}
NOBODY = {"sub": "8", "preferred_username": "nobody", "groups": ["canteen"]}
ODD = {"sub": "9", "preferred_username": "<script>", "groups": ["maintenance"]}


@pytest.fixture(scope="module")
def provider() -> Iterator[Provider]:
    with Provider(OTTO, NOBODY, ODD) as started:
        yield started


def web_settings(issuer: str, **more: Any) -> WebSettings:
    oidc = {"issuer": issuer, "client_id": "hall", "address": ADDRESS, "roles": ROLES}
    return WebSettings.model_validate({"users": "users.json", "oidc": oidc} | more)


@pytest.fixture
def context(provider: Provider, tmp_path: Path) -> Iterator[Context]:
    settings = web_settings(provider.url)
    assert settings.oidc is not None
    users = Users(tmp_path / "users.json")
    users.add("vera", "viewer", PASSWORD)
    sign_on = SingleSignOn(OidcClient(settings.oidc, SECRET))
    with open_context(tmp_path, settings, users, single_sign_on=sign_on) as opened:
        yield opened


def audit(context: Context) -> list[dict[str, Any]]:
    import sqlalchemy as sa

    from servoscope.service.store import tables

    return [dict(row) for row in context.store.fetch(sa.select(tables.audit).order_by(tables.audit.c.id))]


def test_a_user_of_the_provider_gets_the_highest_role_of_its_claim(context: Context) -> None:
    async def visit(browser: httpx.AsyncClient) -> None:
        assert (await browser.get("/api/v1/assets")).status_code == 401
        answer = await log_in(browser)
        assert (answer.status_code, answer.headers["location"]) == (303, "/alarms")
        cookie = next(one for one in answer.headers.get_list("set-cookie") if one.startswith("servoscope="))
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        session = (await browser.get("/api/v1/session")).json()
        assert (session["user"], session["role"]) == ("otto", "operator")
        assert session["csrf"]
        assert (await browser.get("/api/v1/assets")).status_code == 200
        assert (await browser.delete("/api/v1/session")).status_code == 403  # the token is asked for as ever
        assert (await browser.delete("/api/v1/session", headers={"x-csrf-token": session["csrf"]})).status_code == 204
        assert (await browser.get("/api/v1/assets")).status_code == 401

    browse(context, visit)
    row = next(row for row in audit(context) if row["what"] == "login")
    assert (row["who"], row["document"]) == ("otto", {"from": "192.0.2.1", "by": "oidc", "subject": "7"})


def test_users_of_the_file_log_in_as_before(context: Context) -> None:
    async def visit(browser: httpx.AsyncClient) -> str:
        assert (await browser.post("/api/v1/session", json={"user": "vera", "password": PASSWORD})).status_code == 200
        return (await browser.get("/api/v1/session")).json()["role"]

    assert browse(context, visit) == "viewer"


def test_the_request_holds_state_nonce_and_challenge_that_are_new_each_time(context: Context) -> None:
    async def visit(browser: httpx.AsyncClient) -> list[dict[str, list[str]]]:
        return [parse_qs(urlsplit(await go_to_provider(browser)).query) for _ in range(2)]

    first, second = browse(context, visit)
    for name in ("state", "nonce", "code_challenge"):
        assert len(first[name][0]) >= 43
        assert first[name] != second[name]
    assert first["code_challenge_method"] == ["S256"]
    assert first["redirect_uri"] == [f"{ADDRESS}/api/v1/session/oidc/callback"]
    assert (first["response_type"], first["scope"]) == (["code"], ["openid profile"])


@pytest.mark.parametrize(("sub", "why"), [("8", "role"), ("9", "role")])
def test_who_has_no_role_or_no_proper_name_is_refused(context: Context, sub: str, why: str) -> None:
    async def visit(browser: httpx.AsyncClient) -> None:
        answer = await log_in(browser, sub)
        assert answer.headers["location"] == f"/login?refused={why}"
        assert (await browser.get("/api/v1/assets")).status_code == 401

    browse(context, visit)
    assert [row["what"] for row in audit(context)][-1] == "login refused"


def test_an_answer_belongs_to_the_browser_that_asked_and_is_good_once(context: Context) -> None:
    async def visit(browser: httpx.AsyncClient) -> None:
        begun = dict(browser.cookies)
        url = await confirm(await go_to_provider(browser))
        jar = dict(browser.cookies)
        assert jar != begun
        browser.cookies.clear()
        refused = "/login?refused=state"
        assert (await browser.get(url)).headers["location"] == refused  # another browser
        browser.cookies.update({name: value[:-1] + "x" for name, value in jar.items()})
        assert (await browser.get(url)).headers["location"] == refused  # a cookie of one's own
        browser.cookies.clear()
        browser.cookies.update(jar)
        assert (await browser.get(re.sub("state=[^&]*", "state=x", url))).headers["location"] == refused
        assert (await browser.get(url)).headers["location"] == "/alarms"
        browser.cookies.clear()
        browser.cookies.update(jar)
        assert (await browser.get(url)).headers["location"] == "/login?refused=provider"  # the code is used up

    browse(context, visit)


def test_a_code_of_another_login_is_refused_by_the_verifier(context: Context) -> None:
    async def visit(browser: httpx.AsyncClient) -> str:
        stolen = parse_qs(urlsplit(await confirm(await go_to_provider(browser))).query)["code"][0]
        url = await confirm(await go_to_provider(browser))
        return (await browser.get(re.sub("code=[^&]*", f"code={stolen}", url))).headers["location"]

    assert browse(context, visit) == "/login?refused=provider"


def test_guesses_of_codes_are_limited(context: Context) -> None:
    async def attack(browser: httpx.AsyncClient) -> list[int]:
        state = parse_qs(urlsplit(await go_to_provider(browser)).query)["state"][0]
        jar, found = dict(browser.cookies), []
        for k in range(7):
            browser.cookies.clear()
            browser.cookies.update(jar)
            params = {"state": state, "code": f"guess{k}"}
            found.append((await browser.get("/api/v1/session/oidc/callback", params=params)).status_code)
        return found

    assert browse(context, attack) == [303] * 5 + [429] * 2


@pytest.mark.parametrize("target", ["//evil.example/", "https://evil.example/", "/\\evil.example", "javascript:x"])
def test_a_login_leads_to_pages_of_ours_alone(context: Context, target: str) -> None:
    async def visit(browser: httpx.AsyncClient) -> str:
        return (await log_in(browser, target=target)).headers["location"]

    assert browse(context, visit) == "/"


@pytest.mark.parametrize(
    ("sub", "target", "user"),
    [("7", "/alarms", ("otto", "operator")), ("8", "/login?refused=role", None), ("9", "/login?refused=role", None)],
)
def test_names_and_groups_that_a_certified_provider_tells_beside_its_token(
    tmp_path: Path, sub: str, target: str, user: tuple[str, str] | None
) -> None:
    async def visit(browser: httpx.AsyncClient) -> None:
        answer = await browser.get(await confirm_by_forms(await go_to_provider(browser), sub))
        assert answer.headers["location"] == target
        session = (await browser.get("/api/v1/session")).json()
        assert (session["user"], session["role"]) == user if user else (await browser.get("/api/v1/assets")).is_error

    with CertifiedProvider(OTTO, NOBODY, ODD) as other:
        settings = web_settings(other.url)
        assert settings.oidc is not None
        sign_on = SingleSignOn(OidcClient(settings.oidc, SECRET))
        with open_context(tmp_path, settings, Users(tmp_path / "users.json"), single_sign_on=sign_on) as opened:
            browse(opened, visit)


KEY, OTHER_KEY = RSAKey.generate_key(2048, {"kid": "a"}), RSAKey.generate_key(2048, {"kid": "a"})
CLAIMS = {"iss": "https://id.example", "aud": "hall", "sub": "7", "nonce": "n", "iat": 0.0, "exp": 600.0}
BAD_TOKENS: dict[str, tuple[dict[str, Any], Any, dict[str, Any]]] = {
    "another key": ({"alg": "RS256", "kid": "a"}, OTHER_KEY, {}),
    "the secret as key": ({"alg": "HS256", "kid": "a"}, OctKey.import_key(SECRET), {}),
    "another issuer": ({"alg": "RS256", "kid": "a"}, KEY, {"iss": "https://evil.example"}),
    "for another client": ({"alg": "RS256", "kid": "a"}, KEY, {"aud": "gate"}),
    "for several, by another": ({"alg": "RS256", "kid": "a"}, KEY, {"aud": ["hall", "gate"], "azp": "gate"}),
    "of another login": ({"alg": "RS256", "kid": "a"}, KEY, {"nonce": "m"}),
    "without nonce": ({"alg": "RS256", "kid": "a"}, KEY, {"nonce": None}),
    "too old": ({"alg": "RS256", "kid": "a"}, KEY, {"exp": -600.0}),
    "without end": ({"alg": "RS256", "kid": "a"}, KEY, {"exp": None}),
}


def signed(header: dict[str, Any], key: Any, **change: Any) -> str:
    now = int(time.time())
    claims = {name: value for name, value in (CLAIMS | change).items() if value is not None}
    for name in ("iat", "exp"):
        if name in claims:
            claims[name] = now + int(claims[name])
    return jwt.encode(header, claims, key, algorithms=["RS256", "HS256"])


def check_token(text: str, failure: Exception | None = None) -> dict[str, Any]:
    settings = web_settings("https://id.example").oidc
    assert settings is not None
    client = OidcClient(settings, SECRET)
    client._metadata, client._metadata_until = {"token_endpoint": "https://id.example/token"}, float("inf")
    client._keys = KeySet([KEY])

    async def answer(*_: object, **__: object) -> dict[str, str]:
        if failure is not None:
            raise failure
        return {"id_token": text, "access_token": "x", "token_type": "Bearer"}

    async def redeem() -> dict[str, Any]:
        session = client._session()
        session.fetch_token = answer
        client._session = lambda: session  # type: ignore[method-assign]
        return dict(await client.redeem("code", "n", "v"))

    return asyncio.run(redeem())


@pytest.mark.parametrize("case", BAD_TOKENS)
def test_a_token_that_is_wrong_is_refused(case: str) -> None:
    header, key, change = BAD_TOKENS[case]
    assert check_token(signed({"alg": "RS256", "kid": "a"}, KEY))["sub"] == "7"
    with pytest.raises(ProviderError, match=r"^https://id\.example: "):
        check_token(signed(header, key, **change))


def test_a_token_without_signature_and_text_that_is_none_are_refused() -> None:
    body = signed({"alg": "RS256", "kid": "a"}, KEY).split(".")[1]
    for text in (f"eyJhbGciOiJub25lIn0.{body}.", "", "a.b.c", "{}"):
        with pytest.raises(ProviderError):
            check_token(text)


def test_what_a_provider_repeats_of_the_request_is_not_told() -> None:
    with pytest.raises(ProviderError) as refused:
        check_token("", OAuthError("invalid_client", f"the secret {SECRET} is wrong"))
    assert str(refused.value) == "https://id.example: invalid_client"


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "authlib.common.errors", None)
    monkeypatch.delitem(sys.modules, "servoscope.web.oidc_client")
    with pytest.raises(ConfigError, match=r"^authlib is missing, pip install 'servoscope\[oidc\]'$"):
        importlib.import_module("servoscope.web.oidc_client")


def test_a_provider_that_is_away_is_told_without_a_traceback(context: Context) -> None:
    settings = web_settings("http://127.0.0.1:1").oidc
    assert settings is not None and context.single_sign_on is not None
    context.single_sign_on.client.__init__(settings, SECRET)  # type: ignore[misc]

    async def visit(browser: httpx.AsyncClient) -> str:
        return (await browser.get("/api/v1/session/oidc")).headers["location"]

    assert browse(context, visit) == "/login?refused=provider"


def test_roles_come_from_nested_claims_and_from_texts_too() -> None:
    settings = web_settings("https://id.example").oidc
    assert settings is not None
    nested = settings.model_copy(update={"role_claim": "realm_access.roles"})
    assert nested.role({"realm_access": {"roles": ["shift", "maintenance"]}}) == "engineer"
    assert settings.role({"groups": "shift"}) == "operator"
    for claims in ({}, {"groups": None}, {"groups": 3}, {"groups": [["shift"]]}, {"groups": {"shift": 1}}):
        assert settings.role(claims) is None


SETTINGS = """[sources.line]
kind = "replay"
[assets.press]
baseline = "baseline.json"
source = "line"
files = ["healthy.csv"]
[store]
url = "history.sqlite"
[web]
listen = "127.0.0.1:0"
{web}
[web.oidc]
issuer = "{issuer}"
client_id = "hall"
address = "http://localhost:8080"
roles.viewer = ["everybody"]
{oidc}
"""
WRONG = {
    "issuer without TLS": ("", "http://id.example", "", "https://"),
    "secret in the address": ("", "https://me:hush1@id.example", "", "without user"),
    "two secrets": ("", "https://id.example", 'secret_env = "A"\nsecret_file = "b"', "not both"),
    "scopes": ("", "https://id.example", 'scopes = ["profile"]', "openid"),
    "key": ("", "https://id.example", 'rolls = "x"', "roles"),
    "role": ("", "https://id.example", 'roles.admin = ["x"]', "admin"),
    "no secret": ("", "https://id.example", 'secret_env = "SURELY_NOT_SET"', "SURELY_NOT_SET"),
    "no file": ("", "https://id.example", 'secret_file = "none"', "none"),
}


@pytest.mark.parametrize("case", WRONG)
def test_settings_that_are_wrong_are_one_line(case: str, tmp_path: Path) -> None:
    web, issuer, oidc, word = WRONG[case]
    config = tmp_path / "hall.toml"
    config.write_text(SETTINGS.format(web=web, issuer=issuer, oidc=oidc))
    Store.open("history.sqlite", tmp_path, write=True).close()
    assert "hush1" not in one_line(run("serve", config), word)


def test_login_by_password_can_only_be_switched_off_where_another_is_left() -> None:
    with pytest.raises(ValueError, match="password_login"):
        WebSettings(users="users.json", password_login=False)
    assert web_settings("https://id.example", users=None, listen="0.0.0.0:80").login
    with pytest.raises(ConfigError, match="SURELY"):
        settings = web_settings("https://id.example").oidc
        assert settings is not None
        settings.model_copy(update={"secret_env": "SURELY_NOT_SET"}).load_secret(Path())


def test_a_server_without_passwords_lets_nobody_in_but_by_the_provider_and_tells_no_secret(
    provider: Provider, tmp_path: Path
) -> None:
    (tmp_path / "client.secret").write_text(SECRET)
    config, oidc = tmp_path / "hall.toml", 'secret_file = "client.secret"'
    config.write_text(SETTINGS.format(web="password_login = false", issuer=provider.url, oidc=oidc))
    with Served(tmp_path, "serve", str(config)) as served, served.client() as client:
        session = client.get("/session").json()
        assert (session["login_required"], session["password_login"]) == (True, False)
        assert session["single_sign_on"] == "Single sign-on"
        assert client.get("/assets").status_code == 401
        assert client.post("/session", json={"user": "vera", "password": PASSWORD}).status_code == 409
        begun = client.get("/session/oidc")
        led = httpx.post(begun.headers["location"], data={"sub": "7"}).headers["location"]
        code = parse_qs(urlsplit(led).query)["code"][0]
        back = client.get(f"/session/oidc/callback?{urlsplit(led).query}")
        assert back.headers["location"] == "/"
        assert client.get("/session").json()["user"] == "otto"
        assert client.get("/assets").status_code == 200
        bad = client.get("/session/oidc")
        query = parse_qs(urlsplit(bad.headers["location"]).query)
        again = client.get("/session/oidc/callback", params={"state": query["state"][0], "code": code})
        assert again.headers["location"] == "/login?refused=provider"
        pages = client.get("/audit").text + httpx.get(f"{served.url}/login").text + json.dumps(session)
        pages += httpx.get(f"{served.url}/metrics", cookies=client.cookies).text
    kept = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".secret")
    assert "single sign-on" in served.log
    for hidden in (SECRET, code):
        assert hidden not in served.log + pages
        assert hidden.encode() not in kept


@pytest.mark.slow
def test_a_browser_comes_back_from_the_provider_to_the_page_it_wanted(provider: Provider, tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
    browser_path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser_path is None:
        pytest.skip("no chromium")
    (tmp_path / "client.secret").write_text(SECRET)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    text = SETTINGS.format(web="password_login = false", issuer=provider.url, oidc='secret_file = "client.secret"')
    config = tmp_path / "hall.toml"
    # the provider is at 127.0.0.1: to the browser that is another site than localhost
    config.write_text(text.replace("127.0.0.1:0", f"127.0.0.1:{port}").replace("localhost:8080", f"localhost:{port}"))
    with Served(tmp_path, "serve", str(config)), playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        page = chromium.new_page()
        for sub, heard in (("8", "have no role here"), ("7", "otto, viewer")):
            page.goto(f"http://localhost:{port}/alarms")
            page.get_by_role("link", name="Single sign-on").click()
            page.wait_for_url(f"{provider.url}/**")
            page.get_by_role("button", name=sub, exact=True).click()
            page.get_by_text(heard).wait_for()
        assert page.url == f"http://localhost:{port}/alarms"
        chromium.close()
