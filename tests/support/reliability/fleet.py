"""The fleet of the reliability benchmark: recordings, baseline, service file, and what has to come out of it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from servoscope.baseline.baseline import Baseline
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop
from servoscope.service.sources.replay import ReplayStream
from servoscope.signals import writers
from servoscope.signals.readers import read
from servoscope.simulation import FaultEvent, reference, simulate

LOOP = Path(__file__).parents[3] / "src/servoscope/simulation/reference-rig.toml"
MINUTES = 10  # of each recording
LEAKS_AT = 300  # s into the recording with a fault
BLOCK_S = 30.0  # of a block: of 200 assets, 40 times as fast, 267 come per second
HEALTHY = 4  # different recordings
BEGAN = 1767225600.0  # 2026-01-01T00:00:00Z


@dataclass(frozen=True)
class Fleet:
    """Assets that replay recordings for some hours; one in twenty springs a leak now and then.

    Parameters
    ----------
    folder
        Where its recordings and service files are.
    assets, hours, speed
        How many, for how long (simulated), at how many times the true speed.
    block_s
        Length of a block [s].
    began
        Time of the first sample (epoch, s).
    """

    folder: Path
    assets: int
    hours: float
    speed: float
    block_s: float = BLOCK_S
    began: float = BEGAN

    @property
    def start(self) -> str:
        """Time of the first sample, as files say it."""
        return datetime.fromtimestamp(self.began, UTC).isoformat()

    @property
    def rounds(self) -> int:
        """How many recordings each asset replays."""
        return max(1, round(self.hours * 60.0 / MINUTES))

    @property
    def names(self) -> list[str]:
        """Names of the assets."""
        return [f"press-{i:03d}" for i in range(self.assets)]

    def files(self, name: str) -> list[str]:
        """Return which recordings an asset replays."""
        i = self.names.index(name)
        files = [f"healthy-{(i + k) % HEALTHY}.csv" for k in range(self.rounds)]
        if i % 20 == 0 and self.rounds > 2:
            files[1 + (i // 20) % (self.rounds - 2) :: 36] = ["leaky.csv"] * len(
                files[1 + (i // 20) % (self.rounds - 2) :: 36]
            )
        return files

    def make(self) -> None:
        """Write recordings and baseline."""
        loop = Loop.load(LOOP)
        r = reference("multisine", 60.0 * MINUTES, loop.sample_rate)
        for k in range(HEALTHY):
            writers.write_recording(self.folder / f"healthy-{k}.csv", simulate(loop, r, seed=k)[0])
        leak = [FaultEvent.parse(f"C_ie=1.2@{LEAKS_AT}")]
        writers.write_recording(self.folder / "leaky.csv", simulate(loop, r, faults=leak, seed=HEALTHY)[0])
        nominal_baseline(loop).save(self.folder / "baseline.json")

    def config(self, name: str, store: str, listen: str, assets: list[str], speed: float) -> Path:
        """Write a service file."""
        lines = [
            'name = "fleet"',
            f'[service]\nlisten = "{listen}"\nlog = "info"',
            f'[store]\nurl = "{store}"',
            "[diagnosis]\nevery_s = 3600.0",
            "[alarms.fault]\noff_delay_s = 10.0",
            f'[sources.line]\nkind = "replay"\nspeed = {speed}\nblock = {self.block_s}\nstart = {self.start}',
        ]
        lines += [
            f'[assets.{asset}]\nbaseline = "baseline.json"\nsource = "line"\nfiles = {self.files(asset)}'.replace(
                "'", '"'
            )
            for asset in assets
        ]
        path = self.folder / f"{name}.toml"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    def expected(self) -> dict[str, tuple[int, int, int]]:
        """Return blocks, samples and digest of each asset, computed from the recordings alone."""
        baseline = Baseline.load(self.folder / "baseline.json")
        loop = baseline.loop
        recordings = {path.name: read(path, loop) for path in self.folder.glob("*.csv")}
        found: dict[str, tuple[int, int, int]] = {}
        known: dict[tuple[str, ...], tuple[int, int, int]] = {}
        for name in self.names:
            files = tuple(self.files(name))
            if files not in known:
                tape = ReplayStream(
                    tuple(recordings[file] for file in files), round(self.block_s * loop.sample_rate), False
                )
                blocks = samples = digest = 0
                while (block := tape.block(name, blocks, self.began)) is not None:
                    blocks, samples, digest = (
                        blocks + 1,
                        samples + block.t.size,
                        zlib.crc32(block.signals.tobytes(), digest),
                    )
                known[files] = blocks, samples, digest
            found[name] = known[files]
        return found
