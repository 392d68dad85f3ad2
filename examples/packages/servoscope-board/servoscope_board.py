"""A publisher that keeps the newest verdicts in a text file."""

from contextlib import suppress
from pathlib import Path
from typing import Literal

from servoscope.service.publishers.base import PublisherSettings


class BoardSettings(PublisherSettings):
    """The table `[outlets.NAME]` of kind `board`."""

    kind: Literal["board"]
    file: str

    def create(self, name, folder):
        """Return the publisher; `folder` is that of the service file."""
        return Board(folder / self.file)


class Board:
    """The newest verdict of each asset, in a text file."""

    def __init__(self, path: Path):
        self.path, self.verdicts = path, {}

    def open(self, statuses):
        """Publish what was stored before the start."""
        self.publish(statuses)

    def publish(self, statuses):
        """Write the verdicts; neither block nor raise."""
        self.verdicts |= {name: status["verdict"] for name, status in statuses.items() if "verdict" in status}
        with suppress(OSError):  # the next one may succeed
            self.path.write_text("".join(f"{name}: {verdict}\n" for name, verdict in self.verdicts.items()))

    def close(self):
        """Release nothing: the file is closed after each writing."""
