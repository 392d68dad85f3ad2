"""What the routes of one server share, and the roles that they require."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, HTTPException, Request

from servoscope.service.access import Role, Session, Sessions, Users, WebSettings, is_permitted
from servoscope.service.config import ServiceFile
from servoscope.service.store import Store
from servoscope.web.connections import ConnectionTable
from servoscope.web.event_hub import EventHub
from servoscope.web.jobs.queue import JobQueue
from servoscope.web.login_gate import LoginGate
from servoscope.web.storage import FileStorage, UploadStorage


@dataclass(frozen=True)
class Context:
    """Made once per server."""

    settings: WebSettings  # the section ``[web]``
    store: Store
    config: ServiceFile | None  # the service file; None where the server stands over a store alone
    storage: FileStorage
    uploads: UploadStorage
    event_hub: EventHub
    jobs: JobQueue
    users: Users | None  # None: no login by password
    sessions: Sessions
    login_gate: LoginGate = field(default_factory=LoginGate)
    proxy_secret: bytes | None = None  # of `[web.sign_on]`
    connections: ConnectionTable = field(default_factory=lambda: ConnectionTable(100, 100))


@dataclass(frozen=True)
class Principal:
    """The user of a request."""

    user: str
    role: Role
    session: Session | None = None  # None where there is no login
    session_secret: str | None = None


LOCAL_PRINCIPAL = Principal("local", "engineer")  # over loopback without login


def _get_context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


def get_principal(request: Request) -> Principal | None:
    """Return the user that the middleware has authenticated; None: nobody is logged in."""
    principal: Principal | None = request.scope.get("who")
    return principal


def require_role(role: Role) -> Callable[..., Principal]:
    """Return a dependency that admits this role, and those above it."""

    def check(who: Annotated[Principal | None, Depends(get_principal)]) -> Principal:
        if who is None:
            raise HTTPException(401, "log in first")
        if not is_permitted(who.role, role):
            raise HTTPException(403, f"{who.user} is {who.role}, this needs {role}")
        return who

    return check


ContextDep = Annotated[Context, Depends(_get_context)]
OptionalPrincipal = Annotated[Principal | None, Depends(get_principal)]
VIEWER = Depends(require_role("viewer"))
Operator = Annotated[Principal, Depends(require_role("operator"))]
Engineer = Annotated[Principal, Depends(require_role("engineer"))]
