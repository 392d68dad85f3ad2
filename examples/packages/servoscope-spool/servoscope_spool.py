"""Messages as files ASSET/NAME in a folder, in the order of their names; a file is removed when it is stored."""

import time
from typing import Literal

from servoscope.service.mapping.rows import MessageMapping
from servoscope.service.mapping.settings import PayloadSettings
from servoscope.service.sources.inbox import Inbox
from servoscope.service.sources.message import InboxMessage, RejectionCounter, Transport
from servoscope.service.sources.settings import SourceSettings


class SpoolSettings(SourceSettings):
    """The table `[sources.NAME]` of kind `spool`."""

    kind: Literal["spool"]
    path: str  # the folder, relative to the service file
    payload: PayloadSettings  # where the samples are in messages

    def create(self, name, assets, folder):
        """Return the source: this transport and the decoder of JSON messages."""
        rejections = RejectionCounter()
        decoder = MessageMapping.of_assets(self.payload, assets, rejections)
        return Inbox(SpoolTransport(folder / self.path), decoder, assets, rejections)


class SpoolTransport(Transport):
    """Files of a folder, each a message."""

    def __init__(self, folder):
        super().__init__()
        self.folder, self.received = folder, set()

    def open(self, resume):
        """Say whether the folder is there."""
        self.trouble = "" if self.folder.is_dir() else f"{self.folder}: no such folder"

    def receive(self, most):
        """Return new files as messages, at once and in order."""
        files = sorted(path for path in self.folder.glob("*/*") if path not in self.received)[:most]
        self.received.update(files)
        return [self.message(path, path.relative_to(self.folder).as_posix()) for path in files]

    def message(self, path, address):
        """Return a message that removes its file when it is released."""
        return InboxMessage(address, path.read_bytes(), time.monotonic(), release=path.unlink)

    def close(self):
        """Release nothing: no file stays open."""
