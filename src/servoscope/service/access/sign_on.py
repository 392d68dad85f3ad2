"""The section `[web.sign_on]`: a proxy signs users in, and says in headers of each request who they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from hmac import compare_digest
from typing import Annotated

from pydantic import Field

from servoscope.core.errors import AccessError
from servoscope.core.settings import NonEmptyStr
from servoscope.service.access.users import ROLES, USER_NAME, Role
from servoscope.service.config_types import SecretSettings, matching

HeaderName = Annotated[
    str,
    Field(strict=True),
    matching(r"[A-Za-z0-9-]{1,64}", "{value!r} is no header, write a name such as X-Forwarded-User"),
]
Values = Annotated[tuple[NonEmptyStr, ...], Field(min_length=1)]


class SignOnSettings(SecretSettings):
    """Headers of a proxy, and which groups give which role; the secret shows that the proxy has written them."""

    user_header: HeaderName = "X-Forwarded-User"  # the user's name
    groups_header: HeaderName = "X-Forwarded-Groups"  # its groups
    separator: NonEmptyStr = ","  # between groups
    secret_header: HeaderName = "X-Proxy-Secret"  # the secret; required unless the server listens on a Unix socket
    roles: Annotated[dict[Role, Values], Field(min_length=1)]  # groups by the role that they give

    def identify(self, header: Callable[[str], Sequence[str]], secret: bytes | None) -> tuple[str, Role] | None:
        """Return user and highest role of a request; None: the proxy names nobody.

        Parameters
        ----------
        header
            Returns all values of a header.
        secret
            What the proxy has to repeat; None: only the proxy can connect.

        Raises
        ------
        AccessError
            If the secret is missing or wrong, or the user has no proper name or no role.
        """
        users = header(self.user_header)
        if not users:
            return None
        given = ",".join(header(self.secret_header)).encode("utf-8", "replace")
        if secret is not None and not compare_digest(given, secret):
            raise AccessError(f"{self.secret_header}: not the secret of [web.sign_on], the proxy has to send it")
        if len(users) > 1 or not USER_NAME.fullmatch(users[0]):
            raise AccessError(f"{self.user_header}: no name of a user: letters, digits, . _ - @, at most 64")
        held = {group.strip() for value in header(self.groups_header) for group in value.split(self.separator)}
        role = next((role for role in reversed(ROLES) if held & set(self.roles.get(role, ()))), None)
        if role is None:
            raise AccessError(
                f"{users[0]} has no role here: no group of {self.groups_header} is in [web.sign_on] roles"
            )
        return users[0], role
