"""Atomic writing of files: neither a reader nor a crash leaves a half-written one."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servoscope.core.errors import OutputError


def atomic_write(path: str | Path, content: bytes) -> None:
    """Write a file through a temporary one beside it, which is then renamed.

    The old content stays until all of the new one is on disk, and for good if anything fails. A link is followed, an
    existing file keeps its permissions; the folder must exist.

    Raises OutputError if the file cannot be written.
    """
    try:
        target = Path(path).resolve()
        if target.is_dir():
            raise OutputError(f"{path}: is a directory, give the name of a file")
        if not target.parent.is_dir():
            raise OutputError(f"{path}: cannot be written, there is no folder {Path(path).parent}")
        if target.exists() and not target.is_file():
            target.write_bytes(content)  # a device or a pipe, which must not be renamed away
            return
        _replace(target, content)
    except (OSError, RuntimeError, ValueError) as error:  # the last two: a loop of links, a zero byte in the name
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{path!s}: cannot be written ({reason})".replace("\0", "?")) from None


def make_folder(folder: Path) -> None:
    """Make a folder and its parents where there are none yet; raises OutputError if that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made a folder ({error.strerror or error})") from None


@contextmanager
def exclusive_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and keep other commands that write a set of files there from it meanwhile.

    Raises OutputError if there is one already: files of both would lie beside each other.
    """
    make_folder(folder)
    import fcntl  # late: only Unix has it

    try:
        handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be used ({error.strerror or error})") from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"{folder}: another command writes there now, wait for it or name another folder"
            ) from None
        except OSError:
            pass  # some network drives have no locks
        yield
    finally:
        os.close(handle)  # which unlocks it; a killed process unlocks it too


def _replace(target: Path, content: bytes) -> None:
    if target.exists() and not os.access(target, os.W_OK):
        raise PermissionError(0, "the file is write-protected")
    temporary = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # otherwise a power cut may leave the new name with nothing behind it
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o7777)
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
