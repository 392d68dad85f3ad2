"""Log in, log out, and the user of a session."""

from __future__ import annotations

import asyncio
import time

from fastapi import APIRouter, HTTPException, Request, Response
from starlette.requests import ClientDisconnect

from servoscope import __version__
from servoscope.web.dependencies import Context, ContextDep, OptionalPrincipal, Principal
from servoscope.web.middleware import cookie_name
from servoscope.web.schemas.requests import LoginRequest
from servoscope.web.schemas.responses import SessionResponse

router = APIRouter(tags=["session"])


def _session_response(context: Context, who: Principal | None) -> SessionResponse:
    session = who.session if who is not None else None
    return SessionResponse(
        login_required=context.settings.login,
        password_login=context.users is not None,
        single_sign_on=None,
        user=who.user if who is not None else None,
        role=who.role if who is not None else None,
        csrf=session.csrf if session is not None else None,
        expires=time.time() + session.expires - time.monotonic() if session is not None else None,
        version=__version__,
    )


@router.get("/session")
async def get_session(context: ContextDep, who: OptionalPrincipal) -> SessionResponse:
    """Return the user of the request."""
    return _session_response(context, who)


@router.post("/session")
async def log_in(context: ContextDep, login: LoginRequest, request: Request, response: Response) -> SessionResponse:
    """Log in; the answer sets the cookie of a session."""
    users = context.users
    if users is None:
        raise HTTPException(409, "there is no login by password here")
    address = request.client.host if request.client is not None else ""
    keys = f"from {address}", f"as {login.user}"
    async with context.login_gate.enter(keys) as attempt:
        if await request.is_disconnected():  # while it waited: nobody would read the answer
            raise ClientDisconnect
        role = await asyncio.to_thread(users.check, login.user, login.password)
        stamp = users.stamp(login.user)
        attempt.failed = role is None or stamp is None
    if role is None or stamp is None:
        await asyncio.to_thread(context.store.add_audit, login.user[:64], "", "login refused", {"from": address})
        raise HTTPException(401, "name or password is wrong")
    secret, session = context.sessions.begin(login.user, stamp, time.monotonic())
    await asyncio.to_thread(context.store.add_audit, login.user, "", "login", {"from": address})
    set_session_cookie(context, response, secret)
    return _session_response(context, Principal(login.user, role, session, secret))


def set_session_cookie(context: Context, response: Response, secret: str) -> None:
    """Let the browser keep the secret of a session."""
    secure = context.settings.secure
    response.set_cookie(
        cookie_name(secure),
        secret,
        max_age=round(context.settings.session_hours * 3600.0),
        httponly=True,
        secure=secure,
        samesite="strict",
        path="/",
    )


@router.delete("/session", status_code=204)
async def log_out(context: ContextDep, who: OptionalPrincipal, response: Response) -> None:
    """Log out."""
    if who is not None and who.session_secret is not None:
        context.sessions.end(who.session_secret)
        await asyncio.to_thread(context.store.add_audit, who.user, "", "logout", {})
    secure = context.settings.secure
    response.delete_cookie(cookie_name(secure), path="/", secure=secure, httponly=True, samesite="strict")
