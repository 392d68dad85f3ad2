"""What the answers of one server have in common, and who asks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, Request
from starlette.exceptions import HTTPException

from servoscope.access import Role, Session, Sessions, Users, WebSettings, may
from servoscope.live.config import Config
from servoscope.store import Store
from servoscope.web.folder import Folder
from servoscope.web.hub import Hub
from servoscope.web.jobs import Jobs

__all__ = ["LOCAL", "Context", "In", "Who", "asks", "needs"]


@dataclass(frozen=True)
class Context:
    """Made once per server.

    Parameters
    ----------
    settings
        The section ``[web]``.
    store
        Read, asked for commands, and told what was changed.
    config
        The service file; None where the server stands over a store alone.
    folder
        Uploads, baselines, diagnoses of uploads, designs.
    hub
        Tells what is new in the store.
    jobs
        What takes seconds.
    users
        None: no login.
    sessions
        Who is logged in.
    """

    settings: WebSettings
    store: Store
    config: Config | None
    folder: Folder
    hub: Hub
    jobs: Jobs
    users: Users | None
    sessions: Sessions


@dataclass(frozen=True)
class Who:
    """Who asks.

    Parameters
    ----------
    user, role
        Name, and what that allows.
    session
        None where there is no login.
    secret
        Of the session.
    """

    user: str
    role: Role
    session: Session | None = None
    secret: str | None = None


LOCAL = Who("local", "engineer")  # over loopback without login


def _context(request: Request) -> Context:
    found: Context = request.app.state.context
    return found


def asks(request: Request) -> Who:
    """Return who asks; the guard has looked."""
    found: Who | None = request.scope.get("who")
    if found is None:
        raise HTTPException(401, "log in first")
    return found


def needs(role: Role) -> Callable[..., Who]:
    """Return a dependency that lets this role pass, and those above it."""

    def check(who: Annotated[Who, Depends(asks)]) -> Who:
        if not may(who.role, role):
            raise HTTPException(403, f"{who.user} is {who.role}, this needs {role}")
        return who

    return check


In = Annotated[Context, Depends(_context)]
Plain = dict[str, Any]
Viewer = Annotated[Who, Depends(needs("viewer"))]
Operator = Annotated[Who, Depends(needs("operator"))]
Engineer = Annotated[Who, Depends(needs("engineer"))]
