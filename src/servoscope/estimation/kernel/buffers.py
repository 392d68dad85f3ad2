"""Memory of earlier large results, used again: new memory has to be cleared by the system first."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

MIN_POOLED_BYTES = 1 << 20  # bytes from which it pays
MAX_SPARE_ARRAYS = 2  # arrays that are kept: a service still holds one result when it asks for the next


class BufferPool:
    """Arrays whose memory is used again once nobody holds them, or a view of them, any more."""

    def __init__(self) -> None:
        self._spare: list[npt.NDArray[np.uint8]] = []

    def empty(self, shape: tuple[int, ...], kind: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return an array that is not filled."""
        size = int(np.prod(shape)) * kind.itemsize
        if size < MIN_POOLED_BYTES:
            return np.empty(shape, dtype=kind)
        try:
            piece = self._spare.pop()
        except IndexError:
            piece = np.empty(0, dtype=np.uint8)
        if len(piece) != size:
            piece = np.empty(size, dtype=np.uint8)
        array: npt.NDArray[Any] = np.frombuffer(memoryview(piece), dtype=kind)  # type: ignore[arg-type]  # it is one
        weakref.finalize(array, self._reclaim, piece).atexit = False
        return array.reshape(shape)

    def _reclaim(self, piece: npt.NDArray[np.uint8]) -> None:
        if len(self._spare) < MAX_SPARE_ARRAYS:
            self._spare.append(piece)
