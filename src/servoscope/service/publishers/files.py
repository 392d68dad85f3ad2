"""Publishers that keep files in a folder, for systems that read files: written whole, and only when they change."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write, make_folder
from servoscope.core.settings import NonEmptyStr, Positive
from servoscope.service.assets.status import AssetStatus, read_status
from servoscope.service.publishers.base import PublisherSettings, StatusByAsset


class FilesSettings(PublisherSettings):
    """The keys of all outlets that keep files."""

    path: NonEmptyStr  # the folder, made if it does not exist
    every_s: Positive = 10.0  # time between two looks for what has changed [s]


class FilesPublisher:
    """Keeps the files that `render` returns, from a thread of its own."""

    def __init__(self, folder: Path, every_s: float) -> None:
        self._folder, self._every_s = folder, every_s
        self._changed: dict[str, Mapping[str, Any]] = {}  # statuses of the assets whose files are not yet up to date
        self._written: dict[str, bytes] = {}
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="files", daemon=True)
        self.trouble = ""  # why the files are not up to date

    def render(self, changed: Mapping[str, AssetStatus]) -> Mapping[str, bytes]:
        """Return by name the contents of the files that say something of the assets that have changed."""
        raise NotImplementedError

    def open(self, statuses: StatusByAsset) -> None:
        """Write what the store holds; raises OutputError if the folder cannot be made."""
        make_folder(self._folder)
        self.publish(statuses)
        self._write()
        self._thread.start()

    def publish(self, statuses: StatusByAsset) -> None:
        """Take what has been stored."""
        with self._lock:
            # without the service itself
            self._changed |= {name: status for name, status in statuses.items() if "verdict" in status}

    def _run(self) -> None:
        while not self._stopping.wait(self._every_s):
            self._write()

    def _write(self) -> None:
        with self._lock:
            changed, self._changed = self._changed, {}
        statuses = {name: read_status(stored) for name, stored in changed.items()}
        assets = {name: status for name, status in statuses.items() if isinstance(status, AssetStatus)}
        try:
            for name, content in self.render(assets).items():
                if self._written.get(name) != content:
                    atomic_write(self._folder / name, content)
                    self._written[name] = content
            self.trouble = ""
        except OutputError as error:  # a full disk, a share that is away: the next look tries again
            self.trouble = str(error)
            with self._lock:
                self._changed = changed | self._changed

    def close(self) -> None:
        """Write what is left, and stop."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
            self._write()
