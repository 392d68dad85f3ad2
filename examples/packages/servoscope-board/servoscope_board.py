"""A publisher that keeps the newest verdicts in a text file."""

from pathlib import Path
from typing import Literal

from servoscope.service.publishers.base import PublisherSettings


class BoardSettings(PublisherSettings):
    kind: Literal["board"]
    file: str

    def create(self, name, folder):
        return Board(folder / self.file)


class Board:
    def __init__(self, path: Path):
        self.path, self.verdicts = path, {}

    def open(self, statuses):
        self.publish(statuses)

    def publish(self, statuses):
        self.verdicts |= {name: status["verdict"] for name, status in statuses.items() if "verdict" in status}
        try:
            self.path.write_text("".join(f"{name}: {verdict}\n" for name, verdict in self.verdicts.items()))
        except OSError:
            pass  # the next one may succeed

    def close(self):
        pass
