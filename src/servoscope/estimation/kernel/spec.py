"""What machine code of a recursion is made for: sizes, places in state and constants, and where zeros are."""

from __future__ import annotations

from typing import NamedTuple

from servoscope.estimation.kernel.cusum import LAGS
from servoscope.estimation.kernel.sparse_lti import SparsityPattern
from servoscope.models.plants import Column


class KernelSizes(NamedTuple):
    """The sizes that code is compiled for."""

    n: int
    rows: int
    inputs: int  # no step reads it, but fingerprints of exported monitors count it
    states: int
    speed: int
    gated: bool
    nonlinear: tuple[Column, ...]
    lags: int
    shadow: int
    memory: int
    watched: int
    steady: bool
    extra: int
    frequencies: int
    start: bool
    row: int
    floats: int
    directions: int  # of changes, whose sums move the CUSUMs once per evaluation
    fades: bool  # whether a part of the baseline's covariance counts until the estimate has settled only


class KernelSpec(NamedTuple):
    """Sizes of a recursion and its offsets in state (`to`) and constants (`at`); equal ones share machine code."""

    estimator: str
    sizes: KernelSizes
    to: tuple[tuple[str, int], ...]
    at: tuple[tuple[str, int], ...]
    bank: SparsityPattern
    shadow: SparsityPattern

    @property
    def sums(self) -> int:
        """Number of sums that are taken over an evaluation's updates; 0: each update moves the CUSUMs."""
        return self.sizes.directions * (self.sizes.directions + 3) // 2

    @property
    def shadow_rows(self) -> int:
        """Number of outputs of the shadow, room for as many where there is none."""
        return len(self.shadow[0]) or self.sizes.n + 1

    @property
    def columns(self) -> int:
        """Number of white columns that the sequential test takes of each update."""
        return self.sizes.directions or self.sizes.n + LAGS
