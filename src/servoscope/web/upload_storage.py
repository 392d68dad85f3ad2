"""Uploads with their previews, and how much of the disk they may take together."""

from __future__ import annotations

import json
import threading
from pathlib import Path

from starlette.exceptions import HTTPException

from servoscope.core.files import atomic_write
from servoscope.web.schemas.responses import FilePreview, UploadDetail, UploadRow
from servoscope.web.storage import FileStorage

PREVIEW = "preview.json"  # apart from the record, which is read for every list of uploads
PREVIEW_BYTES = 2e6  # that are reserved for it
BLOCK_BYTES = 4096  # that the smallest file takes
MAX_UPLOADS = 2000  # a list of them is read from as many files


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
