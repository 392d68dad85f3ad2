"""What the server keeps beside the store: uploads, baselines, diagnoses, designs; each in a folder of its own.

A folder without `about.json` is still being made, and does not exist for other requests.
"""

from __future__ import annotations

import re
import secrets
import shutil
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError
from starlette.exceptions import HTTPException

from servoscope.core.files import atomic_write, make_folder
from servoscope.web.schemas.responses import StorageKind, StorageRecord, UploadRow

RecordType = TypeVar("RecordType", bound=StorageRecord)
TEMPORARY_KINDS: tuple[StorageKind, ...] = ("uploads", "learnings")  # kept for some days
NAME = re.compile(r"\w[\w.-]{0,99}")
ABOUT_FILE = "about.json"


class FileStorage:
    """A folder, which is made when something is put into it."""

    def __init__(self, root: Path) -> None:
        self._root = root.absolute()

    def create(self, kind: StorageKind, name: str | None = None) -> tuple[str, Path]:
        """Return id and folder of something new; raises HTTPException 409 if the name is taken, 422 if it is none."""
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

    def folder(self, kind: StorageKind, id_: str) -> Path:
        """Return the folder of something that `create` has made."""
        return self._root / kind / id_

    def folders(self, kind: StorageKind) -> tuple[Path, ...]:
        """Return the folders of all of a kind, complete or not."""
        folder = self._root / kind
        return tuple(folder.iterdir()) if folder.is_dir() else ()

    def publish(self, record: RecordType) -> RecordType:
        """Complete something new with its record, so that other requests find it; return the record."""
        atomic_write(self._root / record.kind / record.id / ABOUT_FILE, record.model_dump_json().encode())
        return record

    def read(self, model: type[RecordType], id_: str) -> RecordType:
        """Return a record; raises HTTPException 404 if there is none."""
        record = _read_record(self._root / model.kind / id_, model) if NAME.fullmatch(id_) else None
        if record is None:
            raise HTTPException(404, f"there is no {id_} among {model.kind}")
        return record

    def path(self, model: type[StorageRecord], id_: str) -> Path:
        """Return the folder of something that `read` finds."""
        return self._root / model.kind / self.read(model, id_).id

    def upload(self, id_: str) -> Path:
        """Return the file of an upload; raises HTTPException 404 if there is none."""
        record = self.read(UploadRow, id_)
        return self._root / record.kind / record.id / record.name

    def upload_paths(self, ids: Iterable[str]) -> Sequence[str]:
        """Return the files of uploads, as `upload` does."""
        return [str(self.upload(id_)) for id_ in ids]

    def list(self, model: type[RecordType]) -> list[RecordType]:
        """Return all records of a kind, the newest last."""
        records = [_read_record(path, model) for path in self.folders(model.kind)]
        return sorted((record for record in records if record is not None), key=lambda record: (record.at, record.id))

    def remove(self, kind: StorageKind, id_: str) -> None:
        """Delete something, complete or not."""
        shutil.rmtree(self._root / kind / id_, ignore_errors=True)

    def remove_expired(self, keep_s: float) -> None:
        """Delete what is older than it is kept for, and what was never completed."""
        for kind in TEMPORARY_KINDS:
            for path in self.folders(kind):
                if path.stat().st_mtime < time.time() - keep_s:
                    self.remove(kind, path.name)


def _read_record(folder: Path, model: type[RecordType]) -> RecordType | None:
    try:
        return model.model_validate_json((folder / ABOUT_FILE).read_bytes())
    except (OSError, ValidationError):
        return None
