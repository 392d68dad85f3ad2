"""What the server keeps beside the store: uploads, baselines, diagnoses, designs; each in a folder of its own.

A folder without `about.json` is still being made, and does not exist for other requests.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError
from starlette.exceptions import HTTPException

from servoscope.core.files import atomic_write, make_folder
from servoscope.web.schemas.responses import FilePreview, StorageKind, StorageRecord, UploadDetail, UploadRow

RecordType = TypeVar("RecordType", bound=StorageRecord)
TEMPORARY_KINDS: tuple[StorageKind, ...] = ("uploads", "learnings")  # kept for some days
NAME = re.compile(r"\w[\w.-]{0,99}")
ABOUT_FILE = "about.json"
PREVIEW = "preview.json"  # apart from the record, which is read for every list of uploads
PREVIEW_BYTES = 2e6  # that are reserved for it
BLOCK_BYTES = 4096  # that the smallest file takes
MAX_UPLOADS = 2000  # a list of them is read from as many files


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


class UploadStorage:
    """The uploads of one server: what is coming counts as if it were there."""

    def __init__(self, storage: FileStorage) -> None:
        self._storage = storage
        self._lock = threading.Lock()
        self._reserved: dict[str, float] = {}  # bytes by id, of those that are not complete

    def create(self, expected: float, most: float) -> tuple[str, Path]:
        """Return id and folder of a new upload of so many bytes.

        Raises HTTPException 507 if all uploads together would take more than `most`.
        """
        with self._lock:  # from the count to the reservation: uploads at once must not pass the limit together
            folders = self._storage.folders("uploads")
            known = [folder for folder in folders if folder.name not in self._reserved]
            taken = sum(map(_disk_usage, known)) + sum(self._reserved.values())
            if taken + expected > most:
                raise HTTPException(507, f"uploads would take more than {most / 1e6:g} MB together: delete some")
            if len(folders) >= MAX_UPLOADS:
                raise HTTPException(507, f"there are {len(folders)} uploads, no more are kept: delete some")
            id_, folder = self._storage.create("uploads")
            self._reserved[id_] = expected + PREVIEW_BYTES
            return id_, folder

    def publish(self, row: UploadRow, preview: FilePreview) -> UploadDetail:
        """Complete an upload, so that other requests find it."""
        folder = self._storage.folder("uploads", row.id)
        atomic_write(folder / PREVIEW, preview.model_dump_json().encode())
        self._storage.publish(row)
        self._release(row.id)
        return UploadDetail(**row.model_dump(), **preview.model_dump())

    def read(self, id_: str) -> UploadDetail:
        """Return an upload with its preview; raises HTTPException 404 if there is none."""
        row = self._storage.read(UploadRow, id_)
        try:
            preview = json.loads((self._storage.folder("uploads", row.id) / PREVIEW).read_bytes())
        except OSError:  # deleted meanwhile
            raise HTTPException(404, f"there is no {id_} among uploads") from None
        return UploadDetail(**row.model_dump(), **preview)

    def discard(self, id_: str) -> None:
        """Delete an upload that was not completed."""
        self._storage.remove("uploads", id_)
        self._release(id_)

    def _release(self, id_: str) -> None:
        with self._lock:
            self._reserved.pop(id_, None)


def _disk_usage(folder: Path) -> float:
    """Return the bytes that a folder of files takes, complete or not; of what is deleted meanwhile none."""
    try:
        return float(sum(max(BLOCK_BYTES, path.stat().st_size) for path in folder.iterdir()))
    except OSError:
        return 0.0
