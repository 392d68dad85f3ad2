"""The blocks of one turn: those of assets of one structure go through the kernels together, the others alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray, IndexArray
from servoscope.core.errors import ServoscopeError
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.asset import Asset, NextBlock
from servoscope.service.asset_states import AssetStates
from servoscope.service.layer_times import LayerTimes
from servoscope.service.records import StepResult
from servoscope.service.sources.block import Block


class BlockResult(NamedTuple):
    """What a block has led to, or why it is none."""

    block: Block
    result: StepResult | ServoscopeError


class QuietBlocks(NamedTuple):
    """Blocks, at most one of each asset, that have led to nothing but the states after them."""

    assets: list[Asset]
    blocks: list[Block]
    numbers: list[int]  # under which the store has them
    packed: list[bytes]  # their samples, as the store has them


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


class AssetGroups:
    """Follows the blocks of several assets, each as if it were alone, to the last bit."""

    def __init__(self, assets: Mapping[str, Asset], layers: LayerTimes | None = None) -> None:
        self._assets, self.layers = assets, layers or LayerTimes()
        monitors: dict[Hashable, dict[int, Monitor]] = defaultdict(dict)
        kinds: dict[int, Hashable | None] = {}  # of the monitors, which assets share
        for monitor in {id(asset.monitor): asset.monitor for asset in assets.values()}.values():
            kinds[id(monitor)] = key = monitor.lane_key
            if key is not None:
                monitors[key][id(monitor)] = monitor
        members: dict[Hashable, list[str]] = defaultdict(list)
        for name, asset in assets.items():
            members[kinds[id(asset.monitor)]].append(name)
        self._fleets, self._places = list[_Fleet](), dict[str, _Place]()  # of assets that have company
        for key, own in monitors.items():
            if len(names := members[key]) > 1:
                size = len(assets[names[0]].monitor.init())
                baselines = {each: i for i, each in enumerate(own)}
                for row, name in enumerate(names):
                    asset = assets[name]
                    self._places[name] = _Place(asset, len(self._fleets), baselines[id(asset.monitor)], row)
                self._fleets.append(_Fleet(Monitor.join(list(own.values())), AssetStates(len(names), size)))

    def process(self, blocks: Iterable[Block], latest: float = np.inf) -> Iterator[BlockResult | QuietBlocks]:
        """Process blocks of any assets, those of one asset in their order; yield what they have led to.

        `latest`: the last time that can be true [UTC s].
        """
        waiting = list(blocks)
        while waiting:
            self.layers.enter("assemble")
            turn, later = dict[str, Block](), list[Block]()  # a round has at most one block of each asset
            for one in waiting:
                if one.asset in turn:
                    later.append(one)
                else:
                    turn[one.asset] = one
            waiting = later
            yield from self._process_round(turn.values(), latest)

    def _process_round(self, turn: Iterable[Block], latest: float) -> Iterator[BlockResult | QuietBlocks]:
        together: dict[tuple[int, tuple[int, ...]], list[Block]] = defaultdict(list)
        alone = list[Block]()
        for block in turn:
            place = self._places.get(block.asset)
            try:
                block.start_time()
            except ServoscopeError as error:  # one asset's trouble must not stop the others
                yield BlockResult(block, error)
                continue
            if place is None or not place.asset.heard:
                alone.append(block)
            else:
                together[place.fleet, block.signals.shape].append(block)
        for (fleet, shape), blocks in together.items():
            signals = np.concatenate([one.signals for one in blocks]).reshape(len(blocks), *shape)
            yield from self._process_together(self._fleets[fleet], blocks, signals, latest, alone)
        for block in alone:
            yield BlockResult(block, self._process_alone(block, latest))

    def _process_alone(self, block: Block, latest: float) -> StepResult | ServoscopeError:
        asset = self._assets[block.asset]
        self.layers.enter("judge")
        try:
            accepted = asset.accept(block, latest)
        except ServoscopeError as error:
            return error
        if isinstance(accepted, StepResult):
            return accepted
        self.layers.enter("kernel")
        followed = asset.follow(accepted)
        self.layers.enter("judge")
        return asset.conclude(accepted, followed)

    def _process_together(
        self, fleet: _Fleet, blocks: Sequence[Block], signals: FloatArray, latest: float, alone: list[Block]
    ) -> Iterator[BlockResult | QuietBlocks]:
        """Process blocks of one shape, with these `signals`; those that must go `alone` are added there."""
        self.layers.enter("assemble")
        states, t = fleet.states, signals[:, 0]
        places = [self._places[one.asset] for one in blocks]
        rows = np.array([one.row for one in places])
        for i in np.flatnonzero(~states.columns["is_here"][rows]).tolist():
            places[i].asset.move_state(states, places[i].row)
        lanes = places[0].asset.lanes
        follows = states.are_next(rows, [one.sequence for one in blocks], [one.stream for one in blocks])
        follows &= lanes.are_regular(t, states.columns["last_t"][rows]) & ~(t[:, -1] > latest)
        phases = fleet.monitor.phase(states.monitor[rows])
        for phase in [-1, *np.unique(phases[follows]).tolist()]:
            chosen = np.flatnonzero(follows & (phases == phase) if phase >= 0 else ~follows)
            group = blocks if chosen.size == len(blocks) else [blocks[i] for i in chosen.tolist()]
            if phase < 0 or len(group) == 1:
                alone += group
            else:
                own = signals if group is blocks else signals[chosen]
                yield from self._process_lanes(fleet, group, rows[chosen], own)

    def _process_lanes(
        self, fleet: _Fleet, blocks: Sequence[Block], rows: IndexArray, signals: FloatArray
    ) -> Iterator[BlockResult | QuietBlocks]:
        """Process regular blocks, whose assets are of one phase and have their states in these rows."""
        self.layers.enter("assemble")
        assets, states = [self._assets[one.asset] for one in blocks], fleet.states
        part = fleet.monitor.select(np.array([self._places[one.asset].baseline for one in blocks]))
        before, samples = (states.monitor[rows], states.quality[rows]), int(states.columns["samples"][rows[0]])
        found = assets[0].lanes.follow_lanes(part, before, samples, signals, self.layers)
        are_quiet = states.are_quiet(rows, found)
        for i in np.flatnonzero(~are_quiet).tolist():
            accepted = NextBlock(blocks[i])
            followed = found.lane(i, assets[i].take_state())
            yield BlockResult(blocks[i], assets[i].conclude(accepted, followed))
        quiet = np.flatnonzero(are_quiet)
        if quiet.size:
            own = quiet.tolist()
            mine, theirs = [blocks[i] for i in own], [assets[i] for i in own]
            packed = [one.pack() for one in mine]
            numbers = states.advance(rows[quiet], found, quiet, packed)
            for asset, number, block, samples_of in zip(theirs, numbers, mine, packed, strict=True):
                asset.keep(number, block, samples_of)
            yield QuietBlocks(theirs, mine, numbers, packed)
