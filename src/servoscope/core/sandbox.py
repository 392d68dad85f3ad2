"""Walls around a process that reads what strangers have sent: it opens its own files, and no others.

Landlock is a part of the Linux kernel, from version 5.13 on: a process gives up what it could open, for good. Its rules
are numbered system calls, which the C library does not wrap (Linux, ``Documentation/userspace-api/landlock.rst``).
"""

from __future__ import annotations

import ctypes
import os
import stat
import struct
import sys
import sysconfig
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from servoscope.core.errors import ConfigError

CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446  # system calls
QUERY_VERSION, PATH_BENEATH, PR_SET_NO_NEW_PRIVS = 1, 1, 38
EXECUTE, WRITE_FILE, READ_FILE, READ_FOLDER = 1, 2, 4, 8
FILE_RIGHTS = EXECUTE | WRITE_FILE | READ_FILE | 1 << 14 | 1 << 15  # the last two: truncate, control of devices
MAKE_DEVICE = 1 << 6 | 1 << 11
RIGHTS_BY_VERSION = {1: 13, 2: 14, 3: 15, 4: 15}  # bits of rights to files that a version knows; later ones: 16
BIND_AND_CONNECT = 3  # TCP, from version 4 on
SIGNALS_AND_SOCKETS = 3  # of processes outside, from version 6 on
LIBRARIES = ("lib", "lib64", "usr/lib", "usr/lib64", "usr/local/lib")  # from the root on, as those below
SYSTEM = (
    *("etc/ld.so.cache", "etc/localtime", "etc/ssl/openssl.cnf", "usr/share/zoneinfo", "usr/share/fonts"),
    *("dev/urandom", "dev/random", "proc/cpuinfo", "proc/meminfo", "sys/devices/system/cpu"),
)


@dataclass(frozen=True)
class Sandbox:
    """What a process may open, beside Python, its packages and the libraries of the system.

    Parameters
    ----------
    read
        Files and folders that it reads.
    write
        Folders that it reads and writes, made where there are none; the first takes its temporary files.
    user
        Whose rights it takes, which a process of root can; files are shown, and folders given to this user. None: it
        keeps its own.
    """

    read: tuple[str, ...] = ()
    write: tuple[str, ...] = ()
    user: str | None = None

    def enter(self) -> None:
        """Wall this process in, for good; raises ConfigError if it cannot take the rights of `user`."""
        for folder in self.write:
            with suppress(OSError):
                Path(folder).mkdir(parents=True, exist_ok=True)
        if self.write:
            tempfile.tempdir = os.environ["TMPDIR"] = self.write[0]
        if self.user is not None:
            user, group = find_user(self.user)
            for path in self.read:
                _admit(Path(path), group)
            for path in self.write:
                os.chown(path, user, -1)
            os.setgroups([])
            os.setgid(group)
            os.setuid(user)
        if landlock_version():
            self._restrict_files()

    def _restrict_files(self) -> None:
        version = landlock_version()
        everything = (1 << RIGHTS_BY_VERSION.get(version, 16)) - 1
        fields = (
            everything,
            *([BIND_AND_CONNECT] if version >= 4 else []),
            *([SIGNALS_AND_SOCKETS] if version >= 6 else []),
        )
        ruleset = system_call(CREATE_RULESET, struct.pack(f"{len(fields)}Q", *fields), 8 * len(fields), 0)
        readable = READ_FILE | READ_FOLDER
        for rights, paths in (
            (readable | EXECUTE, (*python_paths(), *LIBRARIES)),
            (readable, (*SYSTEM, *self.read)),
            (readable | WRITE_FILE, ("dev/null",)),
            (everything & ~(EXECUTE | MAKE_DEVICE), self.write),
        ):
            for path in paths:
                _add_rule(ruleset, path, rights & everything)
        _libc().prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        system_call(RESTRICT_SELF, ruleset, 0)
        os.close(ruleset)


def landlock_version() -> int:
    """Return the version of Landlock that this kernel has; 0: none."""
    try:
        return system_call(CREATE_RULESET, None, 0, QUERY_VERSION)
    except (OSError, AttributeError):  # the latter where the system is no Unix
        return 0


def find_user(name: str) -> tuple[int, int]:
    """Return the numbers of a user and its group; raises ConfigError if this process cannot take their rights."""
    import pwd  # late: only Unix has it

    if os.geteuid() != 0:
        raise ConfigError(f"[web] job_user: only a server of root can run jobs as {name!r}, leave the key out")
    try:
        user = pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(f"[web] job_user: there is no user {name!r} on this machine, add it") from None
    return user.pw_uid, user.pw_gid


def _admit(path: Path, group: int) -> None:
    """Let a group read a file or folder that others cannot read, and enter the folder in which it is."""
    for place, rights in ((path.parent, 0o010), (path, 0o050 if path.is_dir() else 0o040)):
        mode = stat.S_IMODE(place.stat().st_mode)
        if ~mode & rights >> 3:
            os.chown(place, -1, group)
            place.chmod(mode | rights)


def python_paths() -> Iterable[str]:
    """Return where the interpreter, its libraries and the packages are that this process imports."""
    paths = {name: path for name, path in sysconfig.get_paths().items() if name not in ("data", "scripts")}
    own = (sys.executable, os.path.realpath(sys.executable), str(Path(sys.prefix, "pyvenv.cfg")))
    # an empty entry is the working directory, where the file lies that is to be read
    return {*paths.values(), *filter(None, sys.path), *own, str(sysconfig.get_config_var("LIBDIR"))}


def system_call(number: int, *arguments: int | bytes | None) -> int:
    """Make a system call; raises OSError if the kernel refuses it."""
    result = int(_libc().syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _add_rule(ruleset: int, path: str, rights: int) -> None:
    try:
        place = os.open(Path("/", path), os.O_PATH | os.O_CLOEXEC)
    except OSError:  # what is not there needs no rule
        return
    try:
        if not stat.S_ISDIR(os.fstat(place).st_mode):
            rights &= FILE_RIGHTS
        system_call(ADD_RULE, ruleset, PATH_BENEATH, struct.pack("=Qi", rights, place), 0)
    finally:
        os.close(place)
