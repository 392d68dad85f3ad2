"""The blocks of one turn: those of assets of one structure go through the kernels together, the others alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import repeat
from typing import NamedTuple, TypeAlias

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IndexArray
from servoscope.core.errors import ServoscopeError
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.idle_monitor import Follower
from servoscope.service.assets.recent_blocks import PackedBlock
from servoscope.service.assets.records import NextBlock, StepResult, TableRow
from servoscope.service.assets.states import AssetStates
from servoscope.service.clock import LayerTimes
from servoscope.service.sources.block import Block
from servoscope.service.store.bundles import pack_samples


class BlockResult(NamedTuple):
    """What a block has led to, or why it is none."""

    block: Block
    result: StepResult | ServoscopeError


class QuietBlocks(NamedTuple):
    """Blocks, at most one of each asset, that have led to nothing but states and rows that are due at their times."""

    assets: list[Asset]
    blocks: list[Block]
    packed: list[PackedBlock]  # their samples, under their numbers, as the store has them
    history: list[tuple[int, TableRow]]  # each row with which of the blocks it is of


class _Fleet(NamedTuple):
    """Assets of one structure, and all baselines that they have."""

    monitor: Monitor
    states: AssetStates


class _Place(NamedTuple):
    """Of an asset in a fleet: the fleet's number, which of its baselines is its own, and its row among the states."""

    asset: Asset
    fleet: int
    baseline: int
    row: int


_PlacedBlock: TypeAlias = tuple[_Place, Block]


class AssetGroups:
    """Follows the blocks of several assets, each as if it were alone, to the last bit."""

    def __init__(self, assets: Mapping[str, Asset], layers: LayerTimes | None = None) -> None:
        self._assets, self.layers = assets, layers or LayerTimes()
        # of the monitors, which assets share
        keys = {monitor: monitor.lane_key for monitor in {asset.monitor for asset in assets.values()}}
        members: dict[Hashable, list[Asset]] = defaultdict(list)
        for asset in assets.values():
            members[keys[asset.monitor]].append(asset)
        self._fleets, self._places = list[_Fleet](), dict[str, _Place]()  # of assets that have company
        for key, together in members.items():
            if key is None or len(together) == 1:
                continue
            monitors = dict.fromkeys(asset.monitor for asset in together if isinstance(asset.monitor, Monitor))
            numbers: dict[Follower, int] = {monitor: i for i, monitor in enumerate(monitors)}
            for row, asset in enumerate(together):
                self._places[asset.name] = _Place(asset, len(self._fleets), numbers[asset.monitor], row)
            states = AssetStates(len(together), len(together[0].monitor.init()))
            self._fleets.append(_Fleet(Monitor.join(list(monitors)), states))

    def process(self, blocks: Iterable[Block], latest: float = np.inf) -> Iterator[BlockResult | QuietBlocks]:
        """Process blocks of any assets, those of one asset in their order; yield what they have led to.

        `latest`: the last time that can be true [UTC s].
        """
        waiting = list(blocks)
        while waiting:
            self.layers.enter("assemble")
            turn, later = dict[str, Block](), list[Block]()  # a round has at most one block of each asset
            for block in waiting:
                if block.asset in turn:
                    later.append(block)
                else:
                    turn[block.asset] = block
            waiting = later
            yield from self._process_round(turn.values(), latest)

    def _process_round(self, turn: Iterable[Block], latest: float) -> Iterator[BlockResult | QuietBlocks]:
        together: dict[tuple[int, tuple[int, ...]], list[_PlacedBlock]] = defaultdict(list)
        alone = list[Block]()
        for block in turn:
            place = self._places.get(block.asset)
            try:
                shape = block.shape
            except ServoscopeError as error:  # one asset's trouble must not stop the others
                yield BlockResult(block, error)
                continue
            if place is None:
                alone.append(block)
            else:
                together[place.fleet, shape].append((place, block))
        for (fleet, shape), placed in together.items():
            # in C order, which digests and kernels need: where each block is in Fortran order, the joined array is too
            joined = np.ascontiguousarray(np.concatenate([block.signals for _, block in placed]))
            signals = joined.reshape(len(placed), *shape)
            yield from self._process_together(self._fleets[fleet], placed, signals, latest, alone)
        for block in alone:
            yield BlockResult(block, self._process_alone(block, latest))

    def _process_alone(self, block: Block, latest: float) -> StepResult | ServoscopeError:
        self.layers.enter("judge")
        try:
            return self._assets[block.asset].process(block, latest, self.layers)
        except ServoscopeError as error:
            return error

    def _process_together(
        self, fleet: _Fleet, placed: Sequence[_PlacedBlock], signals: FloatArray, latest: float, alone: list[Block]
    ) -> Iterator[BlockResult | QuietBlocks]:
        """Process blocks of one shape, with these `signals`; those that must go `alone` are added there."""
        self.layers.enter("assemble")
        states, t = fleet.states, signals[:, 0]
        rows = np.array([place.row for place, _ in placed])
        lanes, is_new = placed[0][0].asset.lanes, np.zeros(len(rows), dtype=np.bool_)
        # first blocks as well: one by one they take twice as long, and all assets of a plant may begin at once
        can_begin = lanes.begin_regularly(t) & ~(t[:, -1] > latest)
        for i in np.flatnonzero(~states.columns["is_here"][rows]).tolist():
            place, block = placed[i]
            if not place.asset.heard:
                if not can_begin[i] or (block.stream and block.sequence):
                    continue
                place.asset.accept(block, latest)
                is_new[i] = True
            place.asset.move_state(states, place.row)
        follows = states.are_next(rows, [block.sequence for _, block in placed], [block.stream for _, block in placed])
        follows &= lanes.timebase.is_regular(t, states.columns["last_t"][rows]) & ~(t[:, -1] > latest)
        follows = (follows & states.columns["is_here"][rows]) | is_new
        monitors = states.monitor[rows]
        phases = fleet.monitor.phase(monitors)
        for phase in [-1, *np.unique(phases[follows]).tolist()]:
            chosen = np.flatnonzero(follows & (phases == phase) if phase >= 0 else ~follows)
            group = [placed[i] for i in chosen.tolist()]
            if phase < 0 or len(group) == 1:
                alone += [block for _, block in group]
            else:
                which = chosen if len(group) < len(placed) else slice(None)  # which copies nothing
                some = rows[which], monitors[which], signals[which], is_new[which]
                yield from self._process_lanes(fleet, group, *some)

    def _process_lanes(
        self,
        fleet: _Fleet,
        placed: Sequence[_PlacedBlock],
        rows: IndexArray,
        monitors: FloatArray,
        signals: FloatArray,
        is_new: BoolArray,
    ) -> Iterator[BlockResult | QuietBlocks]:
        """Process regular blocks, whose assets are of one phase; their states are in these rows.

        `is_new`: which of the assets begin with them.
        """
        self.layers.enter("assemble")
        assets, blocks, states = [place.asset for place, _ in placed], [block for _, block in placed], fleet.states
        part = fleet.monitor.select(np.array([place.baseline for place, _ in placed]))
        before, samples = (monitors, states.quality[rows]), int(states.columns["samples"][rows[0]])
        output = assets[0].lanes.follow_lanes(part, before, samples, signals, is_new, self.layers)
        are_quiet, packed = states.are_quiet(rows, output) & ~is_new, pack_samples(signals)
        for i in np.flatnonzero(~are_quiet).tolist():
            accepted = NextBlock(blocks[i], packed=packed[i])
            followed = output.lane(i, assets[i].take_state())
            yield BlockResult(blocks[i], assets[i].conclude(accepted, followed))
        quiet = np.flatnonzero(are_quiet)
        if quiet.size:
            chosen = quiet.tolist()
            own, theirs = [packed[i] for i in chosen], [assets[i] for i in chosen]
            numbers, history = states.advance(rows[quiet], output, quiet, signals)
            times = signals[quiet, 0][:, [0, -1]].T.tolist()
            kept = list(zip(numbers, *times, repeat(output.size, quiet.size), *zip(*own, strict=True), strict=True))
            for asset, block in zip(theirs, kept, strict=True):
                asset.keep(block)
            yield QuietBlocks(theirs, [blocks[i] for i in chosen], kept, history)
