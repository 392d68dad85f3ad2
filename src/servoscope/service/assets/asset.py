"""One asset of the service: blocks in, rows for the store out; all it remembers is its state and its window."""

from __future__ import annotations

import math
import zlib
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from servoscope.core.messages import message, render
from servoscope.diagnosis.schedule import DiagnosisSchedule
from servoscope.machines.kinds import MachineSource, to_machine
from servoscope.prognosis.forecast import Prognosis
from servoscope.service.alarms import AlarmSettings, AlarmTransition, OperatorCommand
from servoscope.service.assets.alarms import AssetAlarms
from servoscope.service.assets.block_lanes import BlockLanes, Followed
from servoscope.service.assets.checkpoint import AssetState, StreamPosition, check_machine, evolve
from servoscope.service.assets.examination import StoredDiagnosis, carry_covariates, examine_blocks
from servoscope.service.assets.examination_schedule import (
    Announcement,
    ExaminationState,
    PendingDiagnosis,
    accept_diagnosis,
    examination_phase,
    fault_names,
    is_at_rest,
    rest_period,
    restart_after,
    schedule_full_diagnosis,
    update_examination,
)
from servoscope.service.assets.idle_monitor import Follower
from servoscope.service.assets.outlook import AssetLimits, Outlook, PrognosisSettings, single_fault
from servoscope.service.assets.recent_blocks import PackedBlock, RecentBlocks
from servoscope.service.assets.reception import RECEPTION_OK, Reception
from servoscope.service.assets.records import (
    REPEATABLE_TABLES,
    BlockContinuity,
    BlockRefusal,
    NextBlock,
    StepResult,
    TableRow,
    check_continuity,
    diagnosed_rows,
    owed_rows,
    transition_row,
)
from servoscope.service.assets.states import AssetStates, StateHolder
from servoscope.service.assets.status import asset_metadata, asset_status, checks_of_named
from servoscope.service.clock import LayerTimes
from servoscope.service.config import DiagnosisSettings
from servoscope.service.sources.block import Block
from servoscope.service.store.bundles import pack_samples
from servoscope.service.store.rows import coefficient_rows, fault_rows, period_number
from servoscope.signals import quality


@dataclass(frozen=True)
class AssetPolicy:
    """How assets are followed: the sections of the service file that each of them needs."""

    diagnosis: DiagnosisSettings
    quality: quality.QualitySettings
    alarms: AlarmSettings
    residual_every_s: float
    prognosis: PrognosisSettings = field(default_factory=PrognosisSettings)
    limits: AssetLimits = field(default_factory=dict)
    pause_s: float = 0.0  # how long its source may pause
    assets: int = field(default=1, compare=False)  # of the process: one more changes nothing for the others


class Asset(StateHolder):
    """Follows one asset.

    `machine`: at one operating point; `monitor`: of it, shared; `group` and `source`, for users: what it belongs to.
    """

    def __init__(
        self,
        name: str,
        machine: MachineSource,
        monitor: Follower,
        policy: AssetPolicy,
        group: str = "",
        source: str = "",
    ) -> None:
        super().__init__()
        self.name, self.machine, self.policy, self.source = name, to_machine(machine), policy, source
        self.monitor, self._rate, self._phase = monitor, self.machine.rate, examination_phase(name)
        self._schedule = DiagnosisSchedule(policy.diagnosis.window_s, policy.diagnosis.after_s)
        self._metadata = asset_metadata(self.machine, group, policy.diagnosis.window_s, source, policy.pause_s)
        self._limits = policy.quality.limits(self._rate, policy.pause_s)
        self.lanes = BlockLanes(self._rate, self._limits, policy.residual_every_s)
        self.alarms = AssetAlarms(policy.alarms, policy.prognosis.ahead_s, limited=bool(policy.limits))
        self._window = RecentBlocks(name, policy.diagnosis.kept_s, self._rate)
        self._result, self._reception = StepResult([], []), RECEPTION_OK
        self._ticked = False  # whether silence has changed the state since the last block

    def move_state(self, states: AssetStates, row: int) -> None:
        """Let the state be a row of `states`, until it is taken or another one is set."""
        state = self.take_state()
        since, until = rest_period(state.examination)
        from_s, to_s = self.alarms.standstill(state, self.reception)
        undisturbed = self.reception == RECEPTION_OK and not self._ticked
        self._row = states.put(row, state, max(since, from_s), min(until, to_s) if undisturbed else -math.inf)

    @property
    def reception(self) -> Reception:
        """How its samples come in."""
        return self._reception

    @reception.setter
    def reception(self, reception: Reception) -> None:
        if reception is not self._reception and self._state is not None:
            self.take_state()  # what its next block leads to is no longer what it was
        self._reception = reception

    def announce(self, announced: Announcement | None) -> None:
        """Let it learn again after what was done to it; None: it has learned."""
        if announced != self.alarms.announced and self._state is not None:
            state = self.take_state()
            self.state = replace(state, examination=restart_after(state.examination, self.policy.diagnosis, announced))
        self.alarms.announced = announced

    def compile_kernels(self) -> None:
        """Compile what blocks need, so that the first one does not wait for it."""
        nothing, monitor = np.full(2, np.nan), self.monitor
        channels = dict.fromkeys(self.machine.channels, nothing)
        monitor.run_lanes(monitor.init()[None], *(nothing,) * 3, channels=channels)
        quality.check_block(self._limits, quality.init_state(), np.arange(2.0), nothing, nothing, nothing)

    def resume(self, state: AssetState, stored: Iterable[Block]) -> list[Block]:
        """Continue from a checkpoint; `stored`: the blocks in the store, under the store's numbers.

        Returns those that were counted after the checkpoint, for `process`: they lead to nothing but the state after
        them. Raises StateError if it belongs to another baseline or layout.
        """
        check_machine(state, self.name, self.machine.hash, self.monitor.init().shape)
        t = state.position.t
        alarms = self.alarms.begin(self.name, t, state.alarms)
        self.state = replace(state, alarms=alarms, quality=quality.restart_silence(state.quality, t))
        position, blocks = state.position, list(stored)
        counted = [block for block in blocks if block.sequence < position.blocks]
        self._window = RecentBlocks(self.name, self.policy.diagnosis.kept_s, self._rate, counted)
        ahead = position.sequence - position.blocks + 1  # of the sender's numbers; all are of one stream
        return [
            replace(block, sequence=block.sequence + ahead, stream=position.stream)
            for block in blocks
            if block.sequence >= position.blocks
        ]

    def begin(self, position: StreamPosition, before: AssetState | None = None) -> list[TableRow]:
        """Begin with a new state in the place of one whose alarms go on; return the rows that this one owes."""
        before = before or self.state
        alarms = before.alarms_now.items() if before is not None else ()
        self.state = AssetState(
            asset=self.name,
            baseline=self.machine.hash,
            position=position,
            monitor=self.monitor.init(),
            quality=quality.init_state(),
            examination=ExaminationState.begin(position.t, self.policy.diagnosis, self._phase, self.policy.assets),
            alarms=self.alarms.begin(self.name, position.t, {name: alarm for name, alarm in alarms if alarm.sequence}),
        )
        return owed_rows(before)

    def expect(self, now: float) -> None:
        """Wait for the first block from `now` [UTC s] on: an asset that was never heard has a state too."""
        self.begin(StreamPosition(now, now, rows=self.state.position.rows if self.state is not None else 0))

    def status(self, state: AssetState) -> dict[str, Any]:
        """Return what users see of a state, as stored."""
        about = self._metadata | checks_of_named(self.machine, state.examination.faults), self.reception
        return asset_status(state, self.alarms.definitions, *about, self.alarms.announced, self.policy.diagnosis.kept_s)

    @property
    def first_needed_sequence(self) -> int:
        """The number of the first block of the window: earlier ones are no longer needed."""
        first = self._window.first_sequence
        return self.take_state().position.blocks if first is None else first

    def process(self, block: Block, latest: float = math.inf, layers: LayerTimes | None = None) -> StepResult:
        """Process a block; one that was counted before has no effect, nor has one that is later than `latest` [UTC s].

        Raises RecordingError if it is no block: empty, without time, or of signals of different lengths.
        """
        accepted = self.accept(block, latest)
        if isinstance(accepted, StepResult):
            return accepted
        return self.conclude(accepted, self.follow(accepted, layers or LayerTimes()))

    def accept(self, block: Block, latest: float = math.inf) -> NextBlock | StepResult:
        """Begin to process a block, as `process` does: return what is to be followed and concluded, or no effect."""
        start, credible = block.start_time(), block.until(latest)
        if credible is None:
            return self._leave_out(block, "future", ahead_s=start - latest)
        block, start = credible, start if credible is block else credible.start_time()
        continuity = check_continuity(self.take_state().position if self.heard else None, block, latest)
        if not self.heard:
            rows = self._state.position.rows if self._state is not None else 0
            self.begin(StreamPosition(start, start, stream=block.stream, rows=rows))
        if continuity is None:
            position = self.take_state().position
            # its sender sends it again by design, or it is one of the last minutes
            if block.retained or self._window.begins_with(block.t[0]):
                self.state = replace(self.take_state(), position=replace(position, repeated=position.repeated + 1))
                return StepResult([], [])
            return self._leave_out(block, "late", behind_s=position.t - start)
        return NextBlock(block, continuity)

    def follow(self, accepted: NextBlock, layers: LayerTimes) -> Followed:
        """Follow an accepted block alone."""
        state, restart = self.take_state(), accepted.continuity.is_broken
        return self.lanes.follow(self.monitor, state, accepted.block.signals, restart, layers)

    def conclude(self, accepted: NextBlock, followed: Followed) -> StepResult:
        """Take what an accepted block has led to."""
        before = self.take_state()
        self._count(accepted, followed)
        self._examine()
        self._advance_alarms(self.take_state().position.t)
        self._window.trim(self.take_state().position.t, self.take_state().pending_diagnoses)
        undisturbed = self.reception == RECEPTION_OK and not self._ticked
        after, self._ticked = self.take_state(), False
        nothing_else = after.alarms is before.alarms and after.examination is before.examination
        usual_rows = REPEATABLE_TABLES.issuperset(row.table for row in self._result.rows)
        return self._result._replace(repeatable=nothing_else and undisturbed and usual_rows)

    def keep(self, block: PackedBlock) -> None:
        """Keep the samples of a quiet block whose state is there."""
        self._window.append(block)
        self._window.trim(block[2], self.pending_diagnoses)

    def _leave_out(self, block: Block, kind: Literal["late", "future"], **seconds: float) -> StepResult:
        """Count a block that is left out for its time stamps; its place in its stream has passed."""
        refusal, rows = BlockRefusal(kind, render(message(f"service.reception.{kind}", **seconds))), list[TableRow]()
        if self.state is not None:
            position = replace(self.state.position, **{kind: getattr(self.state.position, kind) + 1})
            lost = block.sequence - position.sequence - 1
            if kind == "future" and self.heard and block.stream == position.stream and lost >= 0:
                rows = [BlockContinuity(lost, anew=False).audit_row(position, block)] if lost else []
                position = replace(position, sequence=block.sequence, lost=position.lost + lost)
            self.state = replace(self.state, position=position)
        return StepResult(rows, [], refusal)

    def advance_time(self, elapsed_s: float) -> StepResult:
        """Advance the asset's clock without a block: after a while, silence is an alarm."""
        self._result = StepResult([], [])
        if not self.has_state:
            return self._result
        now = (state := self.take_state()).position.t + elapsed_s
        # before its first block it waits: that is told by its reception, and not as the silence of a sensor
        quality_state, changed = quality.tick(self._limits, state.quality, now) if self.heard else (state.quality, ())
        self._ticked |= bool(changed)
        self.state = replace(state, quality=quality_state)
        if changed or self.reception != RECEPTION_OK or "silent" in quality.active_findings(quality_state):
            self._advance_alarms(now)
        before, after = ([alarm.condition for alarm in at.alarms.values()] for at in (state, self.take_state()))
        return self._result._replace(repeatable=before == after)

    def execute(self, alarm: str, command: OperatorCommand) -> StepResult:
        """Execute an operator's command.

        Raises AlarmError if there is no such alarm, or the command has no meaning in its state.
        """
        self._result = StepResult([], [])
        self.state, transitions = self.alarms.execute(self.take_state(), alarm, command)
        self._add_transitions(transitions)
        return self._result

    def due_diagnoses(
        self, *, ended: bool = False, started: Container[tuple[str, PendingDiagnosis]] = ()
    ) -> list[tuple[PendingDiagnosis, Sequence[Block]]]:
        """Return the full diagnoses whose windows are complete, or end here, with their samples.

        `started`: asset and window of those that are not asked for again.
        """
        t, after_s, pending = self.t, self._schedule.after, self.pending_diagnoses
        # complete, or never to be because the clock was set back
        ready = [window for window in pending if ended or not window.until - after_s <= t < window.until]
        new = [window for window in ready if (self.name, window) not in started]
        return [(window, self._carry_covariates(self._window.within(window))) for window in new]

    def _carry_covariates(self, blocks: Sequence[Block]) -> Sequence[Block]:
        history = self.monitor.covariate_history(self.take_state().monitor)
        return carry_covariates(self.machine.channels, blocks, history, self.take_state().position.t)

    def is_news(self, window: PendingDiagnosis, diagnosis: StoredDiagnosis) -> bool:
        """Return whether a full diagnosis is the first of its fault, or names others than the last one."""
        names, known = map(fault_names, (diagnosis.document.get("faults", []), self.take_state().examination.faults))
        return self._is_first_diagnosis(window) or bool(names and names != known)

    def _is_first_diagnosis(self, window: PendingDiagnosis) -> bool:
        return window.until <= self._schedule.end(self.take_state().examination.since)

    def apply_prognosis(self, prognosis: Prognosis) -> StepResult:
        """Keep a prognosis, and advance the alarms by it."""
        state, self._result = self.take_state(), StepResult([], [])
        self.state = replace(state, outlook=Outlook.from_prognosis(prognosis, state.position.t))
        self._advance_alarms(state.position.t)
        return self._result

    def apply_diagnosis(self, window: PendingDiagnosis, diagnosis: StoredDiagnosis) -> StepResult:
        """Store the result of one of `due_diagnoses`; a second result for it has no effect."""
        state = self.take_state()
        if window not in state.pending_diagnoses:
            return StepResult([], [])
        known = {"first": self._is_first_diagnosis(window), "exceeded": state.evaluation.exceeded}
        examination, diagnosis = accept_diagnosis(state.examination, window, diagnosis, **known)
        pending = tuple(waiting for waiting in state.pending_diagnoses if waiting != window)
        self.state = replace(state, examination=examination, pending_diagnoses=pending)
        self._window.trim(state.position.t, pending)
        return StepResult(diagnosed_rows(window, diagnosis, state.baseline), [])

    def _next_row_number(self) -> int:
        position = self.take_state().position
        self.state = replace(self.take_state(), position=replace(position, rows=position.rows + 1))
        return position.rows + 1

    def _add_row(self, table: str, **values: Any) -> None:
        self._result.rows.append(TableRow(table, {"number": self._next_row_number(), **values}))

    def _count(self, accepted: NextBlock, followed: Followed) -> None:
        """Keep a block and the state after it."""
        (block, continuity, packed), state, (after, history) = accepted, self.take_state(), followed
        position, (samples, regular) = state.position, packed or pack_samples(block.signals[None])[0]
        # stored under a number of our own, because the sender's may begin anew
        self._window.append((position.blocks, block.t.item(0), block.t.item(-1), block.t.size, samples, regular))
        stored = {"sequence": position.blocks, "samples": samples, "regular": regular}
        self._result = StepResult([TableRow("recent", stored)], [])
        if continuity.is_broken:
            self._result.rows.append(continuity.audit_row(position, block))
        counted = evolve(
            position,
            t=position.t if after.last_t is None else after.last_t,
            sequence=block.sequence,
            stream=block.stream,
            blocks=position.blocks + 1,
            samples=position.samples + block.t.size,
            lost=position.lost + continuity.lost,
            digest=zlib.crc32(block.pack(), position.digest),
        )
        self.state = evolve(after, position=counted)
        for row in history:
            self._add_row("residuals", **row)
        evaluation = self.take_state().evaluation
        if evaluation.t is not None and period_number(evaluation.t) != period_number(state.evaluation.t):
            rows = coefficient_rows(evaluation.t, evaluation.status.parameters)
            self._result.rows.extend(TableRow("sizes", row) for row in rows)

    def _examine(self) -> None:
        """Examine the last minutes if that is due, and request a full diagnosis of a new fault."""
        state, settings = self.take_state(), self.policy.diagnosis
        t, known = state.position.t, state.examination
        details = (
            state.evaluation.features,
            single_fault(known.faults or known.before),
            known.verdict,
            self.alarms.assesses,
        )
        if is_at_rest(known, t, state.evaluation.exceeded):
            return
        recent = partial(self._window.after, known.window_begin(t, settings.window_s))
        examination, result = update_examination(
            state.examination,
            settings,
            t,
            state.evaluation.exceeded,
            lambda: examine_blocks(self.machine, self.name, self._carry_covariates(recent()), *details),
            self._phase,
            sound=quality.limit_verdict("fault", quality.active_findings(state.quality)) == "fault",
        )
        self.state = replace(state, examination=examination)
        if result is None:
            return
        if result.size is not None:
            rows = fault_rows(t, "live", [result.size.model_dump(mode="json")])
            self._result.rows.extend(TableRow("sizes", row) for row in rows)
        if result.verdict != state.examination.verdict:
            self._add_row("diagnoses", t=t, grounds="examination", **result.columns(state.baseline))
        examination, in_full = schedule_full_diagnosis(examination, self._schedule, t)
        if in_full:
            window = PendingDiagnosis(self._next_row_number(), recent()[0].sequence, self._schedule.end(t), "full")
            pending = (*self.take_state().pending_diagnoses, window)
            self.state = replace(self.take_state(), examination=examination, pending_diagnoses=pending)

    def _advance_alarms(self, t: float) -> None:
        """Update the alarms at time `t` [UTC s]."""
        self.state, transitions = self.alarms.advance(self.take_state(), self.reception, t)
        self._add_transitions(transitions)

    def _add_transitions(self, transitions: Sequence[AlarmTransition]) -> None:
        self._result.transitions.extend(transitions)
        for transition in transitions:
            self._add_row("transitions", **transition_row(transition, self.alarms.definitions[transition.alarm]))
