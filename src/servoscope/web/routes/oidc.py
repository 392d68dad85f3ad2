"""Log in at an OpenID Connect provider, and come back with a session."""

from __future__ import annotations

import asyncio
import logging
import time
from hmac import compare_digest
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, HTTPException, Query, Request
from starlette.responses import RedirectResponse

from servoscope.service.access.oidc import CALLBACK, OidcSettings
from servoscope.web.dependencies import Context, ContextDep, SingleSignOn
from servoscope.web.login_state import LASTS_S
from servoscope.web.middleware import LOGIN_PATH
from servoscope.web.oidc_client import ProviderError
from servoscope.web.routes.session import set_session_cookie

router = APIRouter(tags=["session"], include_in_schema=False)  # for browsers on their way, not for programs
COOKIE = "servoscope-login"
Text = Annotated[str, Query(max_length=4000)]


def _single_sign_on(context: Context) -> tuple[OidcSettings, SingleSignOn]:
    if context.settings.oidc is None or context.single_sign_on is None:
        raise HTTPException(404, "there is no single sign-on here")
    return context.settings.oidc, context.single_sign_on


def _refuse(context: Context, why: str) -> RedirectResponse:
    """Send the browser back to the login, which says why: `state`, `provider` or `role`."""
    response = RedirectResponse(f"/login?{urlencode({'refused': why})}", 303)
    _delete_cookie(context, response)
    return response


def _delete_cookie(context: Context, response: RedirectResponse) -> None:
    response.delete_cookie(COOKIE, path=LOGIN_PATH, secure=context.settings.secure, httponly=True, samesite="lax")


def _own_page(target: str) -> str:
    """Return an address of our own pages: one of elsewhere could imitate them."""
    is_own = target.startswith("/") and not target.startswith("//") and target.isascii() and target.isprintable()
    return target if is_own and "\\" not in target else "/"


@router.get("/session/oidc")
async def begin_login(context: ContextDep, next: Text = "/") -> RedirectResponse:
    """Send the browser to the provider."""
    _, single_sign_on = _single_sign_on(context)
    state, text = single_sign_on.states.begin(_own_page(next)[:1000], time.monotonic())
    try:
        url = await single_sign_on.client.authorization_url(state.state, state.nonce, state.verifier)
    except ProviderError as error:
        logging.getLogger("servoscope.web").warning("single sign-on: %s", error)
        return _refuse(context, "provider")
    response = RedirectResponse(url, 303)
    # lax: the provider's page leads back here, and the cookie has to come along
    response.set_cookie(
        COOKIE, text, round(LASTS_S), path=LOGIN_PATH, secure=context.settings.secure, httponly=True, samesite="lax"
    )
    return response


@router.get(CALLBACK.removeprefix("/api/v1"))
async def end_login(context: ContextDep, request: Request, state: Text = "", code: Text = "") -> RedirectResponse:
    """Take the provider's code, and begin a session for the user of its ID token."""
    settings, single_sign_on = _single_sign_on(context)
    under_way = single_sign_on.states.read(request.cookies.get(COOKIE, ""), time.monotonic())
    if under_way is None or not compare_digest(state.encode(), under_way.state.encode()):
        return _refuse(context, "state")
    address = request.client.host if request.client is not None else ""
    if not code:  # the user or the provider said no
        return await _refuse_user(context, "", address, "provider")
    async with context.login_gate.enter((f"from {address}",)) as attempt:
        try:
            claims = await single_sign_on.client.redeem(code, under_way.nonce, under_way.verifier)
        except ProviderError as error:
            attempt.failed = True
            logging.getLogger("servoscope.web").warning("single sign-on: %s", error)
            return await _refuse_user(context, "", address, "provider")
    user, role = settings.user_name(claims), settings.role(claims)
    if user is None or role is None:
        return await _refuse_user(context, user or "", address, "role")
    secret, _ = context.sessions.begin(user, "", time.monotonic(), role)
    # names may be given away at the provider, its subjects not
    document: dict[str, Any] = {"from": address, "by": "oidc", "subject": str(claims["sub"])[:255]}
    await asyncio.to_thread(context.store.add_audit, user, "", "login", document)
    response = RedirectResponse(under_way.target, 303)
    _delete_cookie(context, response)
    set_session_cookie(context, response, secret)
    return response


async def _refuse_user(context: Context, user: str, address: str, why: str) -> RedirectResponse:
    document = {"from": address, "by": "oidc", "why": why}
    await asyncio.to_thread(context.store.add_audit, user, "", "login refused", document)
    return _refuse(context, why)
