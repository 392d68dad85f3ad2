"""Full diagnoses and prognoses in a process of their own: work that would hold up the samples of all assets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Any

from servoscope.core.workers import WorkerError, Workers
from servoscope.design.operating_limits import OperatingLimit
from servoscope.machines.kinds import parse_machine
from servoscope.machines.protocol import Machine
from servoscope.prognosis.forecast import Prognosis
from servoscope.service.assets.checkpoint import AssetState
from servoscope.service.assets.examination import StoredDiagnosis, diagnose_blocks, undetermined
from servoscope.service.assets.outlook import AssetLimits, DuePrognosis, current_outlook, single_fault
from servoscope.service.log import log
from servoscope.service.sources.block import Block
from servoscope.service.store import Store
from servoscope.service.store.series import last_renewal, query_sizes

MAX_CACHED_BASELINES = 64  # that the process keeps parsed: a hall may have one for each of thousands of assets
MAX_ATTEMPTS = 2  # of a diagnosis that takes its process down with it
TASK = "servoscope.service.diagnosis_worker:diagnose_packed_blocks"
PROGNOSIS_TASK = "servoscope.service.assets.outlook:prognose_in_worker"


class DiagnosisWorker:
    """Makes full diagnoses, one after the other."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "full-diagnosis")  # waits for results
        self._workers = Workers()
        self._closed = False

    def submit(self, machine: Machine, name: str, blocks: Sequence[Block]) -> Future[StoredDiagnosis]:
        """Ask for the diagnosis of a window."""
        return self._executor.submit(self._diagnose, machine, name, list(blocks))

    def submit_prognosis(self, store: Store, name: str, due: DuePrognosis) -> Future[Prognosis]:
        """Ask when a fault of an asset reaches its limit."""

        def ask() -> Prognosis:
            since = max(due.since, last_renewal(store, name) or due.since)
            series = query_sizes(store, name, due.fault, since)
            columns = {key: getattr(series, key).tolist() for key in ("t", "value", "std")}
            return Prognosis.model_validate(self._workers.run(PROGNOSIS_TASK, due.fault, columns, due.limit))

        return self._executor.submit(ask)

    def close(self) -> None:
        """Stop; a diagnosis under way is dropped."""
        self._closed = True
        self._workers.close()
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _diagnose(self, machine: Machine, name: str, blocks: list[Block]) -> StoredDiagnosis:
        text = machine.to_json()
        packed = [(block.sequence, block.pack()) for block in blocks]
        for _ in range(MAX_ATTEMPTS):
            try:
                return StoredDiagnosis.model_validate(self._workers.run(TASK, text, name, packed))
            except WorkerError as error:
                if self._closed:  # on purpose, then
                    break
                log("error", "full diagnosis lost its process", asset=name, why=str(error))
        return undetermined("crashed")


def find_due_prognosis(state: AssetState, limits: AssetLimits, every_s: float) -> DuePrognosis | None:
    """Return the prognosis that is due of an asset with these limits by fault; None: none is."""
    examination, t = state.examination, state.position.t
    fault, last = single_fault(examination.faults), current_outlook(state.outlook, examination.faults)
    if fault is None or (last is not None and last.asked <= t < last.asked + every_s):
        return None
    limit = limits.get(fault)
    if isinstance(limit, OperatingLimit):
        limit = limit.side(float(examination.faults[0]["ratio"]))
    return None if limit is None else DuePrognosis(fault, limit, examination.onset or 0.0)


def diagnose_packed_blocks(
    _: Callable[[str], None], machine: str, name: str, packed: Sequence[tuple[int, bytes]]
) -> dict[str, Any]:
    """Diagnose a window in the worker's process."""
    blocks = [Block.unpack(name, *fields) for fields in packed]
    return diagnose_blocks(_parse_machine(machine), name, blocks).model_dump(mode="json")


@lru_cache(MAX_CACHED_BASELINES)
def _parse_machine(text: str) -> Machine:
    return parse_machine(text)
