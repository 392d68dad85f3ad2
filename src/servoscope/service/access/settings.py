"""The section `[web]`: where the pages are served, to whom, and within which limits."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from servoscope.core.networks import Network
from servoscope.core.settings import NonEmptyStr, Positive, Settings
from servoscope.service.access.allowed_hosts import LOOPBACK, UNIX, is_loopback, split_address
from servoscope.service.access.sign_on import SignOnSettings

REMOVED = {  # keys of 1.0, with their remedies
    "oidc": "a proxy signs users in: see [web.sign_on]",
    "password_login": "users of a file may log in where `users` names one: leave it out",
}


class WebSettings(Settings):
    """Where pages and HTTP interface are served; every key has a default."""

    # ``host:port``, where port 0 takes a free one; or ``unix:`` and the path of a socket, relative to the service file
    listen: Annotated[str, Field(strict=True, pattern=r"^(unix:.+|.+:\d{1,5})$")] = "127.0.0.1:8080"
    # names under which it is reached, beside those of the loopback interface and numeric addresses
    hosts: tuple[NonEmptyStr, ...] = ()
    users: NonEmptyStr | None = None  # file of users, see ``servoscope users``; required beyond loopback
    sign_on: SignOnSettings | None = None  # single sign-on by a proxy
    # where uploads, baselines, diagnoses of uploads and designs are kept; relative to the service file
    folder: NonEmptyStr = "servoscope-web"
    certificate: NonEmptyStr | None = None  # certificate, key: PEM files: then it speaks HTTPS
    key: NonEmptyStr | None = None
    proxies: tuple[Network, ...] = ()  # whose X-Forwarded-For and X-Forwarded-Proto are believed
    # most connections of one address at a time; those of `proxies` are not counted
    connections_per_address: Annotated[int, Field(strict=True, ge=1)] = 100
    session_hours: Positive = 12.0  # how long a login lasts [h]
    upload_mb: Positive = 200.0  # largest upload [MB]
    keep_days: Positive = 7.0  # how long uploads are kept [days]
    # processor time [s] and memory [MB] of one diagnosis, learning or design
    job_s: Positive = 300.0
    job_memory_mb: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1000.0)] = 4000.0
    job_user: NonEmptyStr | None = None  # account that jobs run as, where the server runs as root

    @model_validator(mode="before")
    @classmethod
    def _name_remedies(cls, plain: Any) -> Any:
        for key, remedy in REMOVED.items():
            if isinstance(plain, dict) and key in plain:
                raise ValueError(f"{key}: gone since 2.0, {remedy}")
        return plain

    @model_validator(mode="after")
    def _safe(self) -> Self:
        host, port = (LOOPBACK[0], 0) if self.on_socket else split_address(self.listen)
        if port > 65535:
            raise ValueError(f"listen: there is no port {port}")
        elsewhere = [name for name in (host, *self.hosts) if not is_loopback(name) and name not in LOOPBACK]
        if elsewhere and not self.login:
            raise ValueError(
                f"users: missing, {elsewhere[0]} can be reached by others: give a file of users, "
                "which servoscope users add makes, or [web.sign_on]"
            )
        if self.sign_on is not None and not (self.on_socket or self.sign_on.has_secret):
            raise ValueError(
                "sign_on: anybody who connects could write its headers: give secret_env or secret_file, "
                "or listen on a Unix socket"
            )
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate: goes with key, give both or none")
        if self.on_socket and self.secure:
            raise ValueError("certificate: a Unix socket has no TLS, the proxy in front of it ends TLS")
        return self

    @property
    def login(self) -> bool:
        """Whether users have to log in."""
        return self.users is not None or self.sign_on is not None

    @property
    def on_socket(self) -> bool:
        """Whether it listens on a Unix socket, which only a proxy on this machine reaches."""
        return self.listen.startswith(UNIX)

    @property
    def secure(self) -> bool:
        """Whether it serves HTTPS."""
        return self.certificate is not None
