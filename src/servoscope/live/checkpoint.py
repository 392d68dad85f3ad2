"""The state of one asset as bytes: versioned, checked, turned back whole or refused."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from servoscope.alarms import AlarmState
from servoscope.errors import StateError
from servoscope.live.judging import Judged, Window
from servoscope.live.thinning import Thinned
from servoscope.plants import FloatArray

__all__ = ["VERSION", "Counted", "Progress", "pack", "unpack"]

MAGIC = b"servoscope state"
VERSION = 1  # of this format and of all states in it: raised when one of them changes its meaning
HEAD = struct.Struct("<16sHIII")  # magic, version, length of the JSON text, sizes of the two arrays of numbers
DIGEST = 16  # bytes


@dataclass(frozen=True)
class Counted:
    """What was counted of an asset's stream; nothing of it is ever forgotten.

    Parameters
    ----------
    began, t
        Time of the first and of the last sample [UTC s].
    stream, sequence
        Of the last block.
    blocks, samples
        How many.
    lost, repeated
        Blocks that never came, and that came once more and were left out.
    digest
        CRC-32 of all samples, in order.
    rows
        Number of the asset's last row in the store.
    """

    began: float
    t: float
    sequence: int = -1
    blocks: int = 0
    samples: int = 0
    lost: int = 0
    repeated: int = 0
    digest: int = 0
    rows: int = 0
    stream: int = 0


@dataclass(frozen=True, eq=False)
class Progress:
    """Where one asset stands: everything that decides what the next block leads to.

    Parameters
    ----------
    asset
        Its name.
    baseline
        Hash of the baseline that it is compared with.
    counted
        Of its stream.
    monitor
        State of the monitor, shape (size,).
    last
        Time of the last sample that the monitor has seen [UTC s]; None: none.
    fed
        How many samples the monitor has seen.
    quality
        State of `servoscope.quality`, shape (size,).
    thinned, judged
        Between two stored residuals, and between two examinations.
    windows
        Full diagnoses that are wanted.
    alarms
        By name.
    shown
        What is told of the last evaluation: time, statistic, level, residual.
    """

    asset: str
    baseline: str
    counted: Counted
    monitor: FloatArray
    quality: FloatArray
    judged: Judged
    last: float | None = None
    fed: int = 0
    thinned: Thinned = field(default_factory=Thinned)
    windows: tuple[Window, ...] = ()
    alarms: dict[str, AlarmState] = field(default_factory=dict)
    shown: dict[str, Any] = field(default_factory=dict)


def pack(progress: Progress) -> bytes:
    """Return a state as bytes, with version and digest."""
    plain = {
        "asset": progress.asset,
        "baseline": progress.baseline,
        "counted": asdict(progress.counted),
        "judged": asdict(progress.judged),
        "last": progress.last,
        "fed": progress.fed,
        "thinned": asdict(progress.thinned),
        "windows": [asdict(window) for window in progress.windows],
        "alarms": {name: state.to_dict() for name, state in progress.alarms.items()},
        "shown": progress.shown,
    }
    text = json.dumps(plain, separators=(",", ":"), allow_nan=False).encode()
    sizes = progress.monitor.size, progress.quality.size
    numbers = progress.monitor.astype("<f8").tobytes() + progress.quality.astype("<f8").tobytes()
    body = HEAD.pack(MAGIC, VERSION, len(text), *sizes) + text + numbers
    return body + hashlib.blake2b(body, digest_size=DIGEST).digest()


def unpack(packed: bytes, asset: str) -> Progress:
    """Return the state that `pack` wrote.

    Raises
    ------
    StateError
        If it is of another version, or not whole.
    """
    again = f"run --anew {asset} begins with a new state behind the samples that were counted"
    if len(packed) < HEAD.size + DIGEST or packed[:16] != MAGIC:
        raise StateError(f"{asset}: its saved state is torn: restore the store from a copy, or {again}")
    _, version, length, *sizes = HEAD.unpack_from(packed)
    if version != VERSION:
        raise StateError(
            f"{asset}: its saved state is of version {version}, this servoscope reads {VERSION}: "
            f"use the version that wrote it, or {again}"
        )
    body, digest = packed[:-DIGEST], packed[-DIGEST:]
    whole = len(body) == HEAD.size + length + 8 * sum(sizes)
    if not whole or hashlib.blake2b(body, digest_size=DIGEST).digest() != digest:
        raise StateError(f"{asset}: its saved state is torn: restore the store from a copy, or {again}")
    plain = json.loads(body[HEAD.size : HEAD.size + length])
    numbers = np.frombuffer(body[HEAD.size + length :], dtype="<f8").astype(np.float64)
    return Progress(
        asset=plain["asset"],
        baseline=plain["baseline"],
        counted=Counted(**plain["counted"]),
        monitor=numbers[: sizes[0]].copy(),
        quality=numbers[sizes[0] :].copy(),
        judged=Judged(**plain["judged"]),
        last=plain["last"],
        fed=plain["fed"],
        thinned=Thinned(**plain["thinned"]),
        windows=tuple(Window(**window) for window in plain["windows"]),
        alarms=_alarms(plain["alarms"], asset),
        shown=plain["shown"],
    )


def _alarms(plain: Mapping[str, Any], asset: str) -> dict[str, AlarmState]:
    try:
        return {name: AlarmState.from_dict(state) for name, state in plain.items()}
    except StateError as error:
        raise StateError(f"{asset}: {error}; or run --anew {asset}") from None
