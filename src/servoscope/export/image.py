"""The saved state of an exported monitor, for exchange with a `Monitor` on the server.

Little-endian doubles: the state of `Monitor`, number by number, then for how many evaluations a limit has been
exceeded and how many have passed since the alarm. Behind them 8 bytes that tell the baseline, and a CRC-32.
"""

from __future__ import annotations

import hashlib
import struct
import zlib

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import StateError

ALARM_NUMBERS = 2
MARK_BYTES, CRC_BYTES = 8, 4


def fingerprint(structure: str, *numbers: FloatArray | tuple[float, ...]) -> bytes:
    """Return what tells one exported monitor from another, 8 bytes."""
    digest = hashlib.sha256(structure.encode())
    for number in numbers:
        digest.update(np.asarray(number, dtype="<f8").tobytes())
    return digest.digest()[:MARK_BYTES]


def pack_image(mark: bytes, state: FloatArray, exceeding: float, since: float) -> bytes:
    """Return the image of a state (size,) of the monitor with the counters of its alarm."""
    content = np.asarray([*state, exceeding, since], dtype="<f8").tobytes() + mark
    return content + struct.pack("<I", zlib.crc32(content))


def unpack_image(image: bytes, mark: bytes) -> tuple[FloatArray, float, float]:
    """Return the state of the monitor in an image, and the counters of its alarm.

    Raises
    ------
    StateError
        If the image is damaged, or of another baseline.
    """
    content = image[:-CRC_BYTES]
    if len(image) < MARK_BYTES + CRC_BYTES + 8 * ALARM_NUMBERS or struct.pack("<I", zlib.crc32(content)) != image[-4:]:
        raise StateError("the image of the drive's state is damaged: its checksum is wrong; read it again")
    if content[-MARK_BYTES:] != mark:
        raise StateError("the image of the drive's state is of another baseline: give that which was exported")
    numbers = np.frombuffer(content[:-MARK_BYTES], dtype="<f8").astype(np.float64)
    return numbers[:-ALARM_NUMBERS], float(numbers[-2]), float(numbers[-1])
