"""The one record in which samples of a loop travel: files, simulations, the service and the fleet all pass it on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import RecordingError


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one loop in the order of time, one row each; NaN marks a value that is missing."""

    t: FloatArray  # time [s], on the clock of whoever recorded them, shape (N,)
    r: FloatArray  # r, u, y: reference, control input, measured output (SI units), shape (N,)
    u: FloatArray
    y: FloatArray
    restart: BoolArray  # true where a row does not follow its predecessor by one sample period, shape (N,)
    channels: Mapping[str, FloatArray] = field(default_factory=dict)  # further columns by name, shape (N,) each

    @classmethod
    def from_columns(
        cls,
        t: npt.ArrayLike,
        r: npt.ArrayLike,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        restart: npt.ArrayLike | None = None,
        channels: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Samples:
        """Return samples from columns of any numeric type; without `restart`, every row follows its predecessor.

        Raises RecordingError if the columns are not one-dimensional or not of one length.
        """
        t, r, u, y = (np.asarray(column, dtype=np.float64) for column in (t, r, u, y))
        extra = {name: np.asarray(column, dtype=np.float64) for name, column in (channels or {}).items()}
        starts = np.zeros(t.shape, np.bool_) if restart is None else np.asarray(restart, dtype=np.bool_)
        if any(column.ndim != 1 or column.size != t.size for column in (t, r, u, y, starts, *extra.values())):
            raise RecordingError("t, r, u and y must be columns of equal length")
        return Samples(t, r, u, y, starts, extra)

    @classmethod
    def concatenate(cls, parts: Sequence[Samples]) -> Samples:
        """Return several stretches, which have the same channels, as one."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return cls.from_columns([], [], [], [])
        t, r, u, y, restart = (np.concatenate(column) for column in zip(*(part.columns for part in parts), strict=True))
        channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
        return Samples(t, r, u, y, restart, channels)

    @property
    def columns(self) -> tuple[npt.NDArray[Any], ...]:
        """All that has one value per row, channels aside: t, r, u, y, restart."""
        return self.t, self.r, self.u, self.y, self.restart

    def __len__(self) -> int:
        """Return the number of rows N."""
        return len(self.t)

    def __getitem__(self, rows: slice | npt.NDArray[Any]) -> Self:
        """Return some of the rows; a slice copies nothing."""
        channels = {name: column[rows] for name, column in self.channels.items()}
        t, r, u, y = self.t[rows], self.r[rows], self.u[rows], self.y[rows]
        return replace(self, t=t, r=r, u=u, y=y, restart=self.restart[rows], channels=channels)
