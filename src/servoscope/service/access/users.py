"""Users in a file that only its owner may read: names, roles, and passwords as argon2 digests."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, Literal, get_args

from servoscope.core.errors import AccessError
from servoscope.core.files import atomic_write

Role = Literal["viewer", "operator", "engineer"]
ROLES: tuple[Role, ...] = get_args(Role)  # each may do what those before it may
USER_NAME = re.compile(r"\w[\w.@-]{0,63}")
MIN_PASSWORD_CHARS, MAX_PASSWORD_CHARS = 12, 1000
VERSION = 1


def is_permitted(role: Role, needed: Role) -> bool:
    """Tell whether a role is enough."""
    return ROLES.index(role) >= ROLES.index(needed)


class Users:
    """The users of a file, read again when it changes, and created with the first user."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            from argon2 import PasswordHasher
        except ModuleNotFoundError:
            raise AccessError("argon2-cffi is missing, pip install 'servoscope[web]'") from None
        self._hasher = PasswordHasher()  # with the parameters of RFC 9106's second choice
        # compared with the password of an unknown user, so that the time of the answer does not show which users exist
        self._dummy_hash = self._hasher.hash(os.urandom(16).hex())
        self._file_stamp: tuple[int, int] | None = None
        self._users: dict[str, dict[str, Any]] = {}

    def all(self) -> dict[str, Role]:
        """Return roles by name.

        Raises AccessError if the file cannot be used, or others may read it.
        """
        try:
            stat = self._path.stat()
        except FileNotFoundError:
            self._users, self._file_stamp = {}, None
            return {}
        if stat.st_mode & 0o077:
            raise AccessError(f"{self._path}: others may read it, chmod 600 it")
        stamp = stat.st_mtime_ns, stat.st_ino
        if stamp != self._file_stamp:
            self._users, self._file_stamp = self._read(), stamp
        return {name: user["role"] for name, user in self._users.items()}

    def _read(self) -> dict[str, dict[str, Any]]:
        try:
            plain = json.loads(self._path.read_text(encoding="utf-8"))
            users = plain["users"]
            sound = plain["version"] == VERSION and all(
                user["role"] in ROLES and user["password"].startswith("$argon2") for user in users.values()
            )
        except OSError as error:
            raise AccessError(f"{self._path}: cannot be read ({error.strerror or error})") from None
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            sound = False
        if not sound:
            raise AccessError(f"{self._path}: is not a file of users, servoscope users add makes one")
        return dict(users)

    def add(self, name: str, role: Role, password: str) -> None:
        """Add a user, or give one a new role and password.

        Raises AccessError if name or password will not do, or the file cannot be written.
        """
        if not USER_NAME.fullmatch(name):
            raise AccessError(f"{name!r} is no name for a user: letters, digits, . _ - @, at most 64")
        if not MIN_PASSWORD_CHARS <= len(password) <= MAX_PASSWORD_CHARS:
            raise AccessError(f"{name}: the password must have at least {MIN_PASSWORD_CHARS} characters")
        self.all()
        self._write({**self._users, name: {"role": role, "password": self._hasher.hash(password)}})

    def remove(self, name: str) -> None:
        """Remove a user; sessions of it end with that.

        Raises AccessError if there is no such user, or the file cannot be written.
        """
        if name not in self.all():
            raise AccessError(f"{self._path}: has no user {name}")
        self._write({other: user for other, user in self._users.items() if other != name})

    def _write(self, users: dict[str, dict[str, Any]]) -> None:
        try:
            # created for its owner alone before it has content; an existing file keeps its permissions
            os.close(os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600))
        except OSError as error:
            raise AccessError(f"{self._path}: cannot be written ({error.strerror})") from None
        atomic_write(self._path, (json.dumps({"version": VERSION, "users": users}, indent=1) + "\n").encode())
        self._users, self._file_stamp = users, None

    def check(self, name: str, password: str) -> Role | None:
        """Return the role of a user whose password this is, else None; it takes some 50 ms in either case."""
        from argon2.exceptions import Argon2Error, InvalidHashError

        role = self.all().get(name)
        digest = self._users[name]["password"] if role is not None else self._dummy_hash
        try:
            self._hasher.verify(digest, password[:MAX_PASSWORD_CHARS])
        except (Argon2Error, InvalidHashError):
            return None
        return role

    def stamp(self, name: str) -> str | None:
        """Return what changes with a user's password: that ends the sessions that began before."""
        self.all()
        return str(self._users[name]["password"])[-16:] if name in self._users else None
