"""Log in, log out, and who am I."""

from __future__ import annotations

import asyncio
import time
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from starlette.exceptions import HTTPException
from starlette.status import HTTP_204_NO_CONTENT

from servoscope import __version__
from servoscope.access import Attempts
from servoscope.web.asked import Login
from servoscope.web.context import In, Who
from servoscope.web.guard import cookie_name
from servoscope.web.said import SessionSaid

router = APIRouter(tags=["session"])
_attempts = Attempts()
_one = asyncio.Semaphore(2)  # argon2 takes 64 MB and a processor each time


def _who(request: Request) -> Who | None:
    found: Who | None = request.scope.get("who")
    return found


Asking = Annotated[Who | None, Depends(_who)]


def _said(context: In, who: Who | None) -> SessionSaid:
    session = who.session if who is not None else None
    return SessionSaid(
        login_required=context.settings.login,
        user=who.user if who is not None else None,
        role=who.role if who is not None else None,
        csrf=session.csrf if session is not None else None,
        expires=session.expires if session is not None else None,
        version=__version__,
    )


@router.get("/session")
async def me(context: In, who: Asking) -> SessionSaid:
    """Say who asks."""
    return _said(context, who)


@router.post("/session")
async def log_in(context: In, login: Login, request: Request, response: Response) -> SessionSaid:
    """Log in: the answer sets the cookie of a session."""
    users, now = context.users, time.time()
    if users is None:
        raise HTTPException(409, "there is no login here")
    address = request.client.host if request.client is not None else ""
    keys = f"from {address}", f"as {login.user}"
    if (wait := max(_attempts.wait(key, now) for key in keys)) > 0.0:
        raise HTTPException(429, "too many failed logins, wait a minute", {"Retry-After": str(int(wait) + 1)})
    async with _one:
        role = await asyncio.to_thread(users.check, login.user, login.password)
    stamp = users.stamp(login.user)
    if role is None or stamp is None:
        for key in keys:
            _attempts.fail(key, now)
        await asyncio.to_thread(context.store.note, login.user[:64], "", "login refused", {"from": address})
        raise HTTPException(401, "name or password is wrong")
    secret, session = context.sessions.begin(login.user, stamp, now)
    await asyncio.to_thread(context.store.note, login.user, "", "login", {"from": address})
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
    return _said(context, Who(login.user, role, session, secret))


@router.delete("/session", status_code=HTTP_204_NO_CONTENT)
async def log_out(context: In, who: Asking, response: Response) -> None:
    """Log out."""
    if who is not None and who.secret is not None:
        context.sessions.end(who.secret)
        await asyncio.to_thread(context.store.note, who.user, "", "logout", {})
    secure = context.settings.secure
    response.delete_cookie(cookie_name(secure), path="/", secure=secure, httponly=True, samesite="strict")
