"""Where assets go on: from their states in the store, anew under a renewed baseline, or not at all, and why."""

from __future__ import annotations

import bisect
import time
from collections import deque
from collections.abc import Collection, Mapping
from itertools import chain
from typing import NamedTuple

from servoscope.baseline.history import read_history
from servoscope.core.errors import BaselineError, StateError
from servoscope.service.assets.asset import Asset
from servoscope.service.assets.checkpoint import AssetState, StreamPosition, unpack_state
from servoscope.service.assets.groups import AssetGroups
from servoscope.service.assets.reception import UNHEARD_RECEPTION
from servoscope.service.assets.records import TableRow
from servoscope.service.clock import LayerTimes
from servoscope.service.config import ServiceFile
from servoscope.service.log import log
from servoscope.service.sources.block import Block
from servoscope.service.store import Row, Store


class Resumption(NamedTuple):
    """How assets go on."""

    assets: dict[str, Asset]  # those that are followed
    groups: AssetGroups  # of these
    restarted: dict[str, list[TableRow]]  # those that begin with a new state, and the rows that the one before owes
    left_out: dict[str, str]  # the others, and why


def resume_assets(
    config: ServiceFile,
    assets: Mapping[str, Asset],
    store: Store,
    rows: Mapping[str, Row],
    restarted: Collection[str],
    running: Mapping[str, Asset] | None = None,
    layers: LayerTimes | None = None,
) -> Resumption:
    """Let assets go on from their rows in the store; those in `restarted` with a new state behind what was counted.

    So does one whose baseline has taken the place of that of its state. One whose state cannot be used is left out:
    the others do not wait for it. `running`: those of `assets` that go on as they are.
    """
    uncounted, behind = list[Block](), set[str]()  # behind: assets of which the store may know more than their states
    anew, left_out = dict[str, list[TableRow]](), dict[str, str]()
    new = [name for name in assets if running is None or assets[name] is not running.get(name)]
    stored = store.recent_samples_of([name for name in new if name in rows])
    for name, samples in chain(stored, ((name, []) for name in new if name not in rows)):
        asset, blocks = assets[name], [Block.unpack(name, *sample) for sample in samples]
        try:
            state = None if name not in rows else _read_state(rows[name], name, may_be_torn=name in restarted)
            if name in restarted or (state is not None and _is_renewed(config, asset, state, running)):
                anew[name] = []
                if name in rows:
                    anew[name] = asset.begin(_counted(StreamPosition(**rows[name]["status"]["counted"]), blocks), state)
                    behind.add(name)
            elif state is not None:
                left = asset.resume(state, blocks)
                uncounted += left
                behind |= {name} if left else set()
        except StateError as error:
            left_out[name] = str(error)
            log("error", "asset left out", asset=name, why=str(error))
            continue
        if not asset.heard:
            asset.expect(time.time())
            asset.reception = UNHEARD_RECEPTION
    followed = {name: asset for name, asset in assets.items() if name not in left_out}
    groups = AssetGroups(followed, layers)
    # their checkpoints waited; all that they lead to is the state after them
    deque(groups.process(uncounted), maxlen=0)
    for name, number in store.last_residuals(behind).items():
        assets[name].count_rows(number)
    return Resumption(followed, groups, {name: anew[name] for name in assets if name in anew}, left_out)


def _read_state(row: Row, asset: str, *, may_be_torn: bool) -> AssetState | None:
    """Return the state of an asset in its row; raises StateError if it cannot be used, unless it `may_be_torn`."""
    try:
        return unpack_state(row["state"], asset)
    except StateError:
        if not may_be_torn:
            raise
    return None


def _counted(position: StreamPosition, blocks: list[Block]) -> StreamPosition:
    """Return the position behind all blocks that the store has."""
    first = bisect.bisect_left(blocks, position.blocks, key=lambda block: block.sequence)
    for block in blocks[first:]:
        position = position.skip(block.t, block.pack())
    return position


def _is_renewed(config: ServiceFile, asset: Asset, state: AssetState, running: Mapping[str, Asset] | None) -> bool:
    """Whether the baseline of an asset has taken the place of the one that a state belongs to.

    Its history says so: it was put in force while nobody followed the asset. While the service runs, another baseline
    of an asset that it follows is in its file because somebody has written it there.
    """
    if state.baseline == asset.machine.hash:
        return False
    if running is not None and asset.name in running:
        return True
    if asset.machine.loop_baseline is None:
        return False
    path, point = config.baseline_file(asset.name), config.assets[asset.name].point
    try:
        earlier = [baseline.at(point) if point else baseline for baseline in read_history(path).values()]
    except BaselineError as error:
        raise StateError(f"{asset.name}: its saved state belongs to an earlier baseline: {error}") from None
    return state.baseline in [baseline.hash for baseline in earlier]
