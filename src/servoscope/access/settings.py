"""The section `[web]`: where the pages are served, to whom, and within which limits."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from servoscope.access.hosts import LOOPBACK, is_loopback, split
from servoscope.settings import Positive, Settings, Word

__all__ = ["WebSettings"]


class WebSettings(Settings):
    """Where pages and HTTP interface are served; every key has a default.

    Parameters
    ----------
    listen
        ``host:port``; port 0 takes a free one.
    hosts
        Names under which it is reached, beside those of the loopback interface and numeric addresses.
    users
        File of users, see ``servoscope users``; required beyond loopback.
    folder
        Where uploads, baselines, diagnoses of uploads and designs are kept; relative to the service file.
    certificate, key
        PEM files: then it speaks HTTPS.
    session_hours
        How long a login lasts [h].
    upload_mb
        Largest upload [MB].
    keep_days
        How long uploads are kept [days].
    job_s, job_memory_mb
        Processor time [s] and memory [MB] of one diagnosis, learning or design.
    """

    listen: Annotated[str, Field(strict=True, pattern=r"^.+:\d{1,5}$")] = "127.0.0.1:8080"
    hosts: tuple[Word, ...] = ()
    users: Word | None = None
    folder: Word = "servoscope-web"
    certificate: Word | None = None
    key: Word | None = None
    session_hours: Positive = 12.0
    upload_mb: Positive = 200.0
    keep_days: Positive = 7.0
    job_s: Positive = 300.0
    job_memory_mb: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1000.0)] = 4000.0

    @model_validator(mode="after")
    def _safe(self) -> Self:
        host, port = split(self.listen)
        if port > 65535:
            raise ValueError(f"listen: there is no port {port}")
        elsewhere = [name for name in (host, *self.hosts) if not is_loopback(name) and name not in LOOPBACK]
        if elsewhere and self.users is None:
            raise ValueError(
                f"users: missing, {elsewhere[0]} can be reached by others: give a file of users, "
                "which servoscope users add makes"
            )
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate: goes with key, give both or none")
        return self

    @property
    def login(self) -> bool:
        """Whether people have to say who they are."""
        return self.users is not None

    @property
    def secure(self) -> bool:
        """Whether it speaks HTTPS."""
        return self.certificate is not None
