"""What the server keeps beside the store: uploads, baselines, diagnoses, designs; each in a folder of its own.

What is still being made has no `about.json` yet, and is not there for anybody else.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
import time
from pathlib import Path
from typing import Any, Literal

from starlette.exceptions import HTTPException

from servoscope.output import atomic_write, make_folder

__all__ = ["Folder", "Kind"]

Kind = Literal["uploads", "baselines", "diagnoses", "learnings", "designs"]
PASSING: tuple[Kind, ...] = ("uploads", "learnings")  # kept for some days
NAME = re.compile(r"\w[\w.-]{0,99}")
ABOUT = "about.json"


class Folder:
    """The folder; it is made when something is put into it.

    Parameters
    ----------
    root
        Where it is.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def new(self, kind: Kind, name: str | None = None) -> tuple[str, Path]:
        """Return id and folder of something new.

        Raises
        ------
        HTTPException
            409: if the name is taken; 422: if it is none.
        """
        id_ = name if name is not None else secrets.token_hex(8)
        if not NAME.fullmatch(id_):
            raise HTTPException(422, f"name: {id_!r} will not do: letters, digits, _ . -, at most 100")
        make_folder(self._root / kind)
        path = self._root / kind / id_
        try:
            path.mkdir(mode=0o700)
        except FileExistsError:
            raise HTTPException(409, f"{id_} exists, choose another name") from None
        return id_, path

    def done(self, kind: Kind, id_: str, about: dict[str, Any]) -> dict[str, Any]:
        """Let something be there, and return what is said of it: `about`, with id and time."""
        said = {"id": id_, "at": time.time(), **about}
        atomic_write(self._root / kind / id_ / ABOUT, json.dumps(said, allow_nan=False).encode())
        return said

    def about(self, kind: Kind, id_: str) -> dict[str, Any]:
        """Return what is said of something.

        Raises
        ------
        HTTPException
            404: if there is no such thing.
        """
        found = _about(self._root / kind / id_) if NAME.fullmatch(id_) else None
        if found is None:
            raise HTTPException(404, f"there is no {id_} among {kind}")
        return found

    def path(self, kind: Kind, id_: str) -> Path:
        """Return the folder of something that is there."""
        return self._root / kind / str(self.about(kind, id_)["id"])

    def all(self, kind: Kind) -> list[dict[str, Any]]:
        """Return what is said of all of a kind, the newest last."""
        folder = self._root / kind
        found = [_about(path) for path in folder.iterdir()] if folder.is_dir() else []
        return sorted((one for one in found if one is not None), key=lambda one: (one["at"], one["id"]))

    def remove(self, kind: Kind, id_: str) -> None:
        """Take something away, whole or half-made."""
        shutil.rmtree(self._root / kind / id_, ignore_errors=True)

    def sweep(self, keep_s: float) -> None:
        """Take away what is older than it is kept for, and what was never finished."""
        for kind in PASSING:
            folder = self._root / kind
            for path in folder.iterdir() if folder.is_dir() else ():
                if path.stat().st_mtime < time.time() - keep_s:
                    self.remove(kind, path.name)


def _about(path: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads((path / ABOUT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found
