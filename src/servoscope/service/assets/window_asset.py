"""A machine that is judged window by window: its last minutes are diagnosed in a process of their own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from servoscope.machines.protocol import Machine
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.block_lanes import Followed
from servoscope.service.assets.examination import StoredDiagnosis
from servoscope.service.assets.examination_schedule import (
    PendingDiagnosis,
    fault_names,
    schedule_full_diagnosis,
    update_examination,
)
from servoscope.service.assets.idle_monitor import IdleMonitor
from servoscope.service.assets.records import NextBlock, StepResult, TableRow, diagnosis_row
from servoscope.service.assets.residual_history import EvaluationStatus, LatestEvaluation, history_row
from servoscope.service.clock import LayerTimes
from servoscope.service.store.rows import coefficient_rows, fault_rows, period_number
from servoscope.signals import quality

MIN_FILLED = 0.5  # of a window, before it is diagnosed after a pause


class WindowAsset(Asset):
    """Follows one machine that has no follower.

    It is examined once per window, since nothing is known between two examinations, and each of them is a full
    diagnosis. Parameters are those of `Asset`.
    """

    def __init__(self, name: str, machine: Machine, policy: AssetPolicy, group: str = "", source: str = "") -> None:
        settings = policy.diagnosis
        settings = settings.model_copy(update={"every_s": min(settings.every_s, settings.window_s)})
        super().__init__(name, machine, IdleMonitor(), replace(policy, diagnosis=settings), group, source)

    def follow(self, accepted: NextBlock, layers: LayerTimes) -> Followed:
        """Follow an accepted block: of its samples it counts which have all signals."""
        block, restart = accepted.block, accepted.continuity.is_broken
        whole = np.where(np.isfinite(block.covariates).all(axis=0), 0.0, np.nan)
        signals = np.stack([block.t, *[whole] * 3])
        return self.lanes.follow(self.monitor, self.take_state(), signals, restart, layers)

    def _examine(self) -> None:
        """Ask for the diagnosis of the last minutes if that is due."""
        state = self.take_state()
        t, known = state.position.t, state.examination
        is_set_back = t < (known.since if known.examined is None else known.examined) and not state.pending_diagnoses
        if t < known.due and not is_set_back:
            return
        window_s = self.policy.diagnosis.window_s
        first = self._window.after(t - window_s)[0]
        if t - first.start_time() < MIN_FILLED * window_s:
            return
        window = PendingDiagnosis(self._next_row_number(), first.sequence, t, "full")
        state, due = self.take_state(), t + self.policy.diagnosis.every_s
        pending = (*state.pending_diagnoses, window)
        self.state = replace(state, examination=replace(known, due=due), pending_diagnoses=pending)

    def apply_diagnosis(self, window: PendingDiagnosis, diagnosis: StoredDiagnosis) -> StepResult:
        """Store the result of one of `due_diagnoses`; a second result for it has no effect."""
        self._result, state, t = StepResult([], []), self.take_state(), window.until
        if window not in state.pending_diagnoses:
            return self._result
        known, is_fault = state.examination, diagnosis.verdict == "fault"
        diagnosis = diagnosis.with_onset(known.onset) if known.verdict == "fault" else diagnosis
        sound = quality.limit_verdict("fault", quality.active_findings(state.quality)) == "fault"
        examination, _ = update_examination(
            replace(known, due=-math.inf), self.policy.diagnosis, t, is_fault, lambda: diagnosis, sound=sound
        )
        examination, is_row = replace(examination, due=known.due), diagnosis.verdict != known.verdict
        faults = diagnosis.document.get("faults", []) if is_fault else []
        if faults or (is_fault and not examination.named):
            faults = faults or examination.faults
            examination = replace(examination, faults=faults, named=diagnosis.summary, diagnosed=t)
        if is_fault:
            examination, is_again = schedule_full_diagnosis(examination, self._schedule, t)
            is_row |= is_again or fault_names(faults) != fault_names(known.faults)
        is_row |= any(warning["kind"] == "event" for warning in diagnosis.document.get("warnings", []))
        evaluation = self._evaluate(t, diagnosis, is_fault=is_fault)
        pending = tuple(waiting for waiting in state.pending_diagnoses if waiting != window)
        state = self.take_state()  # its rows are counted
        self.state = replace(state, examination=examination, evaluation=evaluation, pending_diagnoses=pending)
        if is_row:
            self._result.rows.append(diagnosis_row(window, diagnosis, state.baseline))
        self._add_sizes(fault_rows(t, "full" if is_row else "live", faults))
        self._window.trim(state.position.t, pending)
        self._advance_alarms(state.position.t)
        return self._result

    def _evaluate(self, t: float, diagnosis: StoredDiagnosis, *, is_fault: bool) -> LatestEvaluation:
        """Return the evaluation that a diagnosis of the minutes before `t` [UTC s] is, and add its rows."""
        before, evidence = self.take_state().evaluation, diagnosis.document.get("evidence")
        if evidence is None:
            return before
        estimates = diagnosis.document["parameters"].items()
        parameters = tuple((name, row["value"], row["std"], row["nominal"]) for name, row in estimates)
        self._add_row("residuals", **history_row(t, evidence, 0.0, ()))
        if period_number(t) != period_number(before.t):
            self._add_sizes(coefficient_rows(t, parameters))
        status = EvaluationStatus(
            t=t, statistic=evidence, level=0.0, peaks=(evidence, 0.0), exceeded=is_fault, parameters=parameters
        )
        return LatestEvaluation.from_status(status)

    def _add_sizes(self, rows: list[dict[str, object]]) -> None:
        self._result.rows.extend(TableRow("sizes", row) for row in rows)
