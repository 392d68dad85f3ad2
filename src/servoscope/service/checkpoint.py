"""The state of one asset as bytes: versioned, checked, and restored whole or not at all."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import asdict, dataclass, field

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import StateError
from servoscope.diagnosis.follower import FollowerState
from servoscope.service.alarms import AlarmState
from servoscope.service.examination_schedule import ExaminationState, PendingDiagnosis
from servoscope.service.outlook import Outlook
from servoscope.service.residual_history import EvaluationStatus, HistoryState

MAGIC = b"servoscope state"
VERSION = 1  # of this format and of all states in it: raised when one of them changes its meaning
HEADER = struct.Struct("<16sHIII")  # magic, version, length of the JSON text, sizes of the two arrays of numbers
DIGEST_BYTES = 16


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


@dataclass(frozen=True, eq=False, kw_only=True)
class AssetState(FollowerState):
    """Everything that decides what the next block of an asset leads to.

    `exceeding` is not saved: the service's alarms follow examinations, which have delays of their own.
    """

    asset: str
    baseline: str  # hash of the baseline that it is compared with
    position: StreamPosition
    quality: FloatArray  # state of `servoscope.signals.quality`, shape (size,)
    examination: ExaminationState
    last_t: float | None = None  # time of the last sample that the monitor processed [UTC s]
    history: HistoryState = field(default_factory=HistoryState)
    pending_diagnoses: tuple[PendingDiagnosis, ...] = ()
    alarms: dict[str, AlarmState] = field(default_factory=dict)
    evaluation: EvaluationStatus = field(default_factory=EvaluationStatus)
    outlook: Outlook | None = None  # None: no prognosis was asked for


def pack_state(state: AssetState) -> bytes:
    """Return a state as bytes, with version and digest."""
    document = {
        "asset": state.asset,
        "baseline": state.baseline,
        "counted": asdict(state.position),
        "judged": asdict(state.examination),
        "last": state.last_t,
        "fed": state.samples,
        "thinned": asdict(state.history),
        "windows": [asdict(window) for window in state.pending_diagnoses],
        "alarms": {name: alarm.to_dict() for name, alarm in state.alarms.items()},
        "shown": state.evaluation.to_json(),
        **({} if state.outlook is None else {"outlook": state.outlook.model_dump(mode="json")}),
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
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
        quality=numbers[sizes[0] :].copy(),
        examination=ExaminationState(**document["judged"]),
        last_t=document["last"],
        samples=document["fed"],
        history=HistoryState(**document["thinned"]),
        pending_diagnoses=tuple(PendingDiagnosis(**window) for window in document["windows"]),
        alarms=alarms,
        evaluation=EvaluationStatus.model_validate(document["shown"]),
        outlook=Outlook.model_validate(document["outlook"]) if "outlook" in document else None,
    )
