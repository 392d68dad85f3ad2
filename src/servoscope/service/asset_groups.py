"""The blocks of one turn: those of assets of one structure go through the kernels together, the others alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ServoscopeError
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.asset import Asset
from servoscope.service.block_lanes import LaneInput, LaneOutput
from servoscope.service.layer_times import LayerTimes
from servoscope.service.records import StepResult
from servoscope.service.sources.block import Block


class BlockOffer(NamedTuple):
    """A block, and the last time that can be true when it comes [UTC s]."""

    block: Block
    latest: float


class _LaneEntry(NamedTuple):
    block: Block
    asset: Asset
    accepted: LaneInput


class AssetGroups:
    """Follows the blocks of several assets, each as if it were alone, to the last bit."""

    def __init__(self, assets: Mapping[str, Asset], layers: LayerTimes | None = None) -> None:
        self._assets, self.layers = assets, layers or LayerTimes()
        members: dict[Hashable, dict[int, Monitor]] = defaultdict(dict)
        kinds: dict[int, Hashable | None] = {}  # of the monitors, which assets share
        for monitor in {id(asset.monitor): asset.monitor for asset in assets.values()}.values():
            kinds[id(monitor)] = key = monitor.lane_key
            if key is not None:
                members[key][id(monitor)] = monitor
        counts: dict[Hashable, int] = defaultdict(int)
        for asset in assets.values():
            counts[kinds[id(asset.monitor)]] += 1
        self._fleets = {key: Monitor.join(list(each.values())) for key, each in members.items() if counts[key] > 1}
        places = {each: i for of in members.values() for i, each in enumerate(of)}
        # of each asset that has company: its fleet, and which of the fleet's baselines is its own
        self._places = {
            name: (kinds[id(asset.monitor)], places[id(asset.monitor)])
            for name, asset in assets.items()
            if kinds[id(asset.monitor)] in self._fleets
        }

    def process(self, blocks: Iterable[BlockOffer]) -> Iterator[tuple[Block, StepResult | ServoscopeError]]:
        """Process blocks of any assets; those of one asset in their order. Yield what each of them has led to."""
        waiting = list(blocks)
        while waiting:
            self.layers.enter("assemble")
            # a round has at most one block of each asset
            now = {one.block.asset: one for one in reversed(waiting)}
            first = {id(one) for one in now.values()}
            turn = [one for one in waiting if id(one) in first]
            waiting = [one for one in waiting if id(one) not in first]
            yield from self._process_round(turn)

    def _process_round(self, turn: Sequence[BlockOffer]) -> Iterator[tuple[Block, StepResult | ServoscopeError]]:
        together: dict[tuple[Hashable, int], list[_LaneEntry]] = defaultdict(list)
        alone = list[_LaneEntry]()
        for block, latest in turn:
            asset = self._assets[block.asset]
            try:
                accepted = asset.accept(block, latest)
            except ServoscopeError as error:  # one asset's trouble must not stop the others
                yield block, error
                continue
            if isinstance(accepted, StepResult):
                yield block, accepted
            elif block.asset in self._places:
                together[self._places[block.asset][0], block.t.size].append(_LaneEntry(block, asset, accepted))
            else:
                alone.append(_LaneEntry(block, asset, accepted))
        for (key, _), entries in together.items():
            signals = np.array([one.accepted.signals for one in entries])
            regular = entries[0].asset.lanes.are_regular([one.accepted for one in entries], signals)
            phases = self._fleets[key].phase(np.array([one.accepted.state.monitor for one in entries]))
            for phase in [-1, *np.unique(phases[regular]).tolist()]:
                rows = np.flatnonzero(regular & (phases == phase) if phase >= 0 else ~regular)
                group = [entries[i] for i in rows.tolist()]
                if phase < 0 or len(group) == 1:
                    alone += group
                else:
                    chosen = signals if len(group) == len(entries) else signals[rows]
                    yield from self._conclude(group, self._follow(self._fleets[key], group, chosen))
        self.layers.enter("kernel")
        yield from self._conclude(alone, [one.asset.lanes.follow(one.asset.monitor, one.accepted) for one in alone])

    def _follow(self, fleet: Monitor, group: Sequence[_LaneEntry], signals: FloatArray) -> list[LaneOutput]:
        places = np.array([self._places[one.block.asset][1] for one in group])
        blocks = [one.accepted for one in group]
        return group[0].asset.lanes.follow_lanes(fleet.select(places), blocks, signals, self.layers)

    def _conclude(
        self, group: Iterable[_LaneEntry], followed: Iterable[LaneOutput]
    ) -> Iterator[tuple[Block, StepResult | ServoscopeError]]:
        self.layers.enter("judge")
        for one, result in zip(group, followed, strict=True):
            yield one.block, one.asset.conclude(result)
