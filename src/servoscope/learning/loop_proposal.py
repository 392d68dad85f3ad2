"""The proposal of a loop file: its lines with their reasons, the plants that were compared, and what to know."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from servoscope.core.files import atomic_write
from servoscope.core.messages import Message, message, render
from servoscope.learning.inspection import Inspection
from servoscope.learning.plant_choice import PlantCandidate
from servoscope.models.loop import Loop

MAX_PLANTS = 6  # of those compared, that the file names


@dataclass(frozen=True)
class ProposalLine:
    """A key of the loop file, its value as TOML, and why it is proposed; `doubtful`: somebody has to confirm it."""

    section: str
    key: str
    value: str
    why: Message
    doubtful: bool = False


@dataclass(frozen=True)
class LoopProposal:
    """A loop with the lines of its file, the plants that were compared, the proposed one first, and what to know."""

    loop: Loop
    lines: tuple[ProposalLine, ...]
    candidates: tuple[PlantCandidate, ...]
    notes: tuple[Message, ...]
    origin: str  # the log that it was made from
    inspections: tuple[tuple[Path, Inspection], ...] = ()  # of the logs that go with the first, by the loop

    def __str__(self) -> str:
        return self.to_toml()

    def save(self, path: str | Path) -> None:
        """Write the loop file with the reasons as comments; raises OutputError if that fails."""
        atomic_write(Path(path), self.to_toml().encode())

    def to_toml(self) -> str:
        """Return the loop file with comments."""
        written = [f"# {render(message('init.origin', log=self.origin))}"]
        section = ""
        for line in self.lines:
            if line.section != section:
                section = line.section
                written += ["", f"[{section}]"]
            written.append(f"{line.key} = {line.value}".ljust(40) + f"  # {render(line.why)}")
        written += ["", f"# {render(message('init.compared', count=len(self.candidates)))}"]
        written += [f"#   {plant.words}: {100.0 * plant.explained:.2f} %" for plant in self.candidates[:MAX_PLANTS]]
        for _, inspected in self.inspections[:1]:
            measured = [vars(at) for at in inspected.frequencies if at.snr is not None]
            written += [f"# {render(message('init.coherence', **at))}" for at in measured]
        # names of columns and files may hold what neither a string nor a comment of TOML may
        return "".join(re.sub(r"[\0-\x1f\x7f]", lambda sign: f"\\u{ord(sign[0]):04X}", line) + "\n" for line in written)


def quoted(text: str) -> str:
    """Return a text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)
