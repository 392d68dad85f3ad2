"""Writing result files whole: a reader, or a crash, never meets a half-written one."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from servoscope.errors import OutputError

__all__ = ["atomic_write", "make_folder"]


def atomic_write(path: str | Path, content: bytes) -> None:
    """Write a file through a temporary one beside it, which is then renamed.

    What stood at `path` stays as it was until all of the new content is on disk, and for good if anything
    fails; the temporary file is removed then. A link is followed, an existing file keeps its permissions.

    Parameters
    ----------
    path
        Where the file shall stand; its folder must exist.
    content
        All of it.

    Raises
    ------
    OutputError
        If the file cannot be written.
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
    except (
        OSError,
        RuntimeError,
        ValueError,
    ) as error:  # the last two: a loop of links, a zero byte in the name
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{path!s}: cannot be written ({reason})".replace("\0", "?")) from None


def make_folder(folder: Path) -> None:
    """Make a folder, and those that it stands in, where there is none yet.

    Raises
    ------
    OutputError
        If that is not possible.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made a folder ({error.strerror or error})") from None


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
