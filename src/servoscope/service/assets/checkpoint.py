"""The state of one asset as bytes: versioned, checked, and restored whole or not at all."""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import StateError
from servoscope.service.alarms import AlarmState
from servoscope.service.assets.examination_schedule import ExaminationState, PendingDiagnosis
from servoscope.service.assets.outlook import Outlook
from servoscope.service.assets.residual_history import EvaluationStatus, HistoryState, LatestEvaluation
from servoscope.service.store.engine import encode_document
from servoscope.signals.quality import upgrade_state

MAGIC = b"servoscope state"
VERSION = 1  # of this format and of all states in it: raised when one of them changes its meaning
HEADER = struct.Struct("<16sHIII")  # magic, version, length of the JSON text, sizes of the two arrays of numbers
DIGEST_BYTES = 16


Record = TypeVar("Record")


def evolve(record: Record, **changes: Any) -> Record:
    """Return what `dataclasses.replace` does, in a tenth of its time, for records that check nothing when made."""
    new = object.__new__(type(record))
    new.__dict__.update(record.__dict__, **changes)
    return new


@dataclass(frozen=True)
class StreamPosition:
    """What was counted of an asset's stream since it began."""

    began: float  # time of the first sample [UTC s]
    t: float  # time of the last sample [UTC s]
    sequence: int = -1  # of the last block
    blocks: int = 0
    samples: int = 0
    lost: int = 0  # blocks that never came
    repeated: int = 0  # blocks that came once more and were left out
    digest: int = 0  # CRC-32 of all samples, in order
    rows: int = 0  # number of the asset's last row in the store
    stream: int = 0  # of the last block
    # late, future: blocks left out for their time stamps: behind what was counted, ahead of the service's clock
    late: int = 0
    future: int = 0

    def skip(self, t: FloatArray, packed: bytes) -> StreamPosition:
        """Return the position after a block, with times `t` [UTC s] and packed like this, that no state follows."""
        return replace(
            self,
            t=float(t[np.isfinite(t)][-1]),
            sequence=self.sequence + 1,
            blocks=self.blocks + 1,
            samples=self.samples + t.size,
            digest=zlib.crc32(packed, self.digest),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class AssetState:
    """Everything that decides what the next block of an asset leads to."""

    asset: str
    baseline: str  # hash of the baseline that it is compared with
    position: StreamPosition
    monitor: FloatArray  # state of the monitor, shape (size,)
    quality: FloatArray  # state of `servoscope.signals.quality`, shape (size,)
    examination: ExaminationState
    samples: int = 0  # that the monitor has processed
    last_t: float | None = None  # time of the last sample that the monitor processed [UTC s]
    history: HistoryState = field(default_factory=HistoryState)
    pending_diagnoses: tuple[PendingDiagnosis, ...] = ()
    alarms: dict[str, AlarmState] = field(default_factory=dict)
    evaluation: LatestEvaluation = field(default_factory=LatestEvaluation)
    outlook: Outlook | None = None  # None: no prognosis was asked for
    # up to when `alarms` have been advanced, where nothing but that has changed since [UTC s]; None: as they say
    alarms_at: float | None = None

    @property
    def alarms_now(self) -> dict[str, AlarmState]:
        """The alarms, each with the time of its last step."""
        if self.alarms_at is None:
            return self.alarms
        return {name: evolve(alarm, at=self.alarms_at) for name, alarm in self.alarms.items()}


def check_machine(state: AssetState, name: str, baseline: str, layout: tuple[int, ...]) -> None:
    """Raise StateError unless a state is of a machine with this baseline and of this layout of the monitor's state."""
    other = "belongs to another baseline" if state.baseline != baseline else "is of another servoscope"
    if state.baseline != baseline or state.monitor.shape != layout:
        raise StateError(
            f"{name}: its saved state {other} ({state.baseline}, now {baseline}): "
            f"run --anew {name} begins with a new state, behind the samples counted"
        )


def pack_state(state: AssetState) -> bytes:
    """Return a state as bytes, with version and digest."""
    at = {} if state.alarms_at is None else {"at": state.alarms_at}
    document = {
        "asset": state.asset,
        "baseline": state.baseline,
        "counted": vars(state.position),
        "judged": state.examination.to_json(),
        "last": state.last_t,
        "fed": state.samples,
        "thinned": vars(state.history),
        "windows": [vars(window) for window in state.pending_diagnoses],
        "alarms": {name: {"version": alarm.VERSION, **vars(alarm), **at} for name, alarm in state.alarms.items()},
        "shown": state.evaluation.status.to_json(),
        **({} if state.outlook is None else {"outlook": state.outlook.model_dump(mode="json")}),
    }
    text = encode_document(document).encode()
    numbers = state.monitor.astype("<f8").tobytes() + state.quality.astype("<f8").tobytes()
    body = HEADER.pack(MAGIC, VERSION, len(text), state.monitor.size, state.quality.size) + text + numbers
    return body + hashlib.blake2b(body, digest_size=DIGEST_BYTES).digest()


def unpack_state(packed: bytes, asset: str) -> AssetState:
    """Return the state that `pack_state` wrote.

    Raises StateError if it is of another version, or torn.
    """
    restart = f"run --anew {asset} begins with a new state behind the samples that were counted"
    torn = StateError(f"{asset}: its saved state is torn: restore the store from a copy, or {restart}")
    if len(packed) < HEADER.size + DIGEST_BYTES or packed[:16] != MAGIC:
        raise torn
    _, version, length, *sizes = HEADER.unpack_from(packed)
    if version != VERSION:
        raise StateError(
            f"{asset}: its saved state is of version {version}, this servoscope reads {VERSION}: "
            f"use the version that wrote it, or {restart}"
        )
    body, digest = packed[:-DIGEST_BYTES], packed[-DIGEST_BYTES:]
    whole = len(body) == HEADER.size + length + 8 * sum(sizes)
    if not whole or hashlib.blake2b(body, digest_size=DIGEST_BYTES).digest() != digest:
        raise torn
    document = json.loads(body[HEADER.size : HEADER.size + length])
    numbers = np.frombuffer(body[HEADER.size + length :], dtype="<f8").astype(np.float64)
    try:
        alarms = {name: AlarmState.from_dict(alarm) for name, alarm in document["alarms"].items()}
    except StateError as error:
        raise StateError(f"{asset}: {error}; or run --anew {asset}") from None
    return AssetState(
        asset=document["asset"],
        baseline=document["baseline"],
        position=StreamPosition(**document["counted"]),
        monitor=numbers[: sizes[0]].copy(),
        quality=upgrade_state(numbers[sizes[0] :].copy()),
        examination=ExaminationState(**document["judged"]),
        last_t=document["last"],
        samples=document["fed"],
        history=HistoryState(**document["thinned"]),
        pending_diagnoses=tuple(PendingDiagnosis(**window) for window in document["windows"]),
        alarms=alarms,
        evaluation=LatestEvaluation.from_status(EvaluationStatus.model_validate(document["shown"])),
        outlook=Outlook.model_validate(document["outlook"]) if "outlook" in document else None,
    )
