"""The section `[web.oidc]`: single sign-on by OpenID Connect, and which claims make which role."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from servoscope.core.settings import NonEmptyStr, Positive
from servoscope.service.access.allowed_hosts import is_loopback
from servoscope.service.access.users import ROLES, USER_NAME, Role
from servoscope.service.config_types import HttpUrl, SecretSettings

CALLBACK = "/api/v1/session/oidc/callback"
Values = Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]


class OidcSettings(SecretSettings):
    """A provider that says who somebody is; without a secret we are a public client."""

    issuer: HttpUrl  # address of the provider, as its ID tokens name it
    client_id: NonEmptyStr  # under which this server is registered there
    address: HttpUrl  # of this server, as browsers call it; with `CALLBACK` behind it, registered at the provider
    scopes: tuple[NonEmptyStr, ...] = ("openid", "profile")
    user_claim: NonEmptyStr = "preferred_username"  # what becomes the name of the user
    role_claim: NonEmptyStr = "groups"  # a text or a list of texts; dots lead into tables
    roles: Annotated[dict[Role, Values], Field(min_length=1)]  # values of that claim, by the role that they give
    label: Annotated[NonEmptyStr, Field(max_length=64)] = "Single sign-on"  # of the button
    timeout_s: Positive = 10.0  # how long one answer of the provider may take [s]

    @field_validator("issuer", "address")
    @classmethod
    def _check_url(cls, value: str) -> str:
        parts = urlsplit(value)
        if parts.username or parts.password or parts.query or parts.fragment:
            raise ValueError("is no address, write https://host/path without user and query")  # it may hold a secret
        if parts.scheme == "http" and not is_loopback(parts.hostname or ""):
            raise ValueError("write https://: codes and tokens can be read on the way")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if "openid" not in self.scopes:
            raise ValueError('scopes: "openid" is missing, without it there is no ID token')
        if urlsplit(self.address).path not in ("", "/"):
            raise ValueError("address: the pages stand at the top of a host, write it without a path")
        return self

    @property
    def callback(self) -> str:
        """Where the provider sends browsers back to."""
        return self.address.rstrip("/") + CALLBACK

    def user_name(self, claims: Mapping[str, Any]) -> str | None:
        """Return the name of the user; None: the claim is missing, or will not do as a name."""
        name = claims.get(self.user_claim)
        return name if isinstance(name, str) and USER_NAME.fullmatch(name) else None

    def role(self, claims: Mapping[str, Any]) -> Role | None:
        """Return the highest role that the claims give; None: they give none."""
        value: Any = claims
        for key in (self.role_claim,) if self.role_claim in claims else self.role_claim.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        texts = [value] if isinstance(value, str) else value if isinstance(value, list) else []
        held = {text for text in texts if isinstance(text, str)}
        return next((role for role in reversed(ROLES) if held & set(self.roles.get(role, ()))), None)
