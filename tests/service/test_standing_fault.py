"""What a fault was stays known: when data stop, when a machine rests, when the newest file of a lake is damaged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import halls
import numpy as np
import pytest

from servoscope.diagnosis.monitor import Monitor
from servoscope.fleet.summary import summarise_fleet
from servoscope.isolation.candidate import FaultEstimate
from servoscope.service.alarms import AlarmSettings
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.examination import StoredDiagnosis, diagnose_blocks, undetermined
from servoscope.service.assets.examination_schedule import (
    ExaminationState,
    PendingDiagnosis,
    accept_diagnosis,
    update_examination,
)
from servoscope.service.assets.status import AssetStatus
from servoscope.service.config import DiagnosisSettings
from servoscope.service.sources.block import Block
from servoscope.signals.quality import QualitySettings

BEGAN = 1767225600.0
SETTINGS = DiagnosisSettings()
FAULT = StoredDiagnosis(verdict="fault", headline=undetermined("none").headline, onset=5.0)
HEALTHY = StoredDiagnosis(verdict="healthy", headline=undetermined("none").headline)


def examined(state: ExaminationState, t: float, result: StoredDiagnosis, **more: bool) -> ExaminationState:
    new, found = update_examination(state, SETTINGS, t, result.verdict == "fault", lambda: result, **more)
    assert found is result
    return new


def test_a_fault_stands_until_something_shows_that_it_has_gone() -> None:
    start = ExaminationState(due=0.0)
    ill = examined(start, 10.0, FAULT)
    assert (ill.fault_at, ill.onset) == (10.0, 5.0)
    at_rest = examined(ill, 1000.0, undetermined("none"))
    assert (at_rest.verdict, at_rest.fault_at, at_rest.onset) == ("undetermined", 10.0, 5.0)
    again = examined(at_rest, 2000.0, FAULT)
    assert again.fault_at == 2000.0
    for gone in (HEALTHY, undetermined("recovering").model_copy(update={"recovering": True})):
        assert examined(at_rest, 3000.0, gone).fault_at is None
    assert examined(start, 10.0, FAULT, sound=False).fault_at is None  # bad data may have made it
    assert examined(ill, 1000.0, FAULT, sound=False).fault_at == 10.0


def test_it_does_not_matter_when_a_full_diagnosis_comes_back() -> None:
    """It is made beside the samples: how long that takes is up to the machine, and what is stored is not."""
    window = PendingDiagnosis(1, 0, 20.0, "full")
    named = FAULT.model_copy(update={"document": {"faults": [{"name": "leakage"}]}})
    ill = examined(ExaminationState(due=0.0), 10.0, FAULT)
    before = examined(accept_diagnosis(ill, window, named, first=True)[0], 1000.0, HEALTHY)
    after = accept_diagnosis(examined(ill, 1000.0, HEALTHY), window, named, first=True)[0]
    assert before == after and before.diagnosed is None
    # the size that an examination finds where the name is known already is older than the diagnosis, so it is not kept
    sized = FAULT.model_copy(
        update={"size": FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.1, 1.3))}
    )
    due = replace(ill, due=0.0)
    assert accept_diagnosis(examined(due, 15.0, sized), window, named, first=True)[0].size == {}
    assert accept_diagnosis(examined(due, 25.0, sized), window, named, first=True)[0].sized == 25.0


@pytest.fixture(scope="module")
def leaky() -> Asset:
    """An asset that has leaked for half a minute, diagnosed in full."""
    policy = AssetPolicy(
        DiagnosisSettings(window_s=40.0), QualitySettings(window_s=2.0), AlarmSettings(), residual_every_s=60.0
    )
    asset, recorded = Asset("press", halls.baseline(), Monitor(halls.baseline()), policy), halls.recorded(2, halls.LEAK)
    size = round(0.5 * recorded.sample_rate)
    for k in range(recorded.samples // size):
        rows = slice(k * size, (k + 1) * size)
        t = BEGAN + recorded.t[rows] - recorded.t[0]
        asset.process(Block("press", k, np.asarray(t), recorded.r[rows], recorded.u[rows], recorded.y[rows]))
    for window, blocks in asset.due_diagnoses(ended=True):
        asset.apply_diagnosis(window, diagnose_blocks(asset.machine, "press", blocks))
    return asset


def test_when_data_stop_the_fault_is_told_with_its_age(leaky: Asset) -> None:
    assert leaky.state is not None
    before = AssetStatus.model_validate(leaky.status(leaky.state))
    assert before.verdict == "fault" and before.faults[0].name == "leakage"
    for seconds in (30.0, 300.0, 7200.0):
        leaky.advance_time(seconds)
    after = AssetStatus.model_validate(leaky.status(leaky.state))
    assert after.verdict == "fault" and after.faults == before.faults and "silent" in after.quality
    assert after.summary.startswith(before.summary) and after.summary.endswith("Now: Undetermined: no data come.")
    assert "Last seen at 2026-01-01 00:0" in after.summary
    # three clocks: the fault, the data, the diagnosis
    assert after.fault_at is not None and BEGAN + 30.0 < after.fault_at <= after.position.t
    assert after.diagnosed is not None and after.diagnosed > after.fault_at - 40.0


def day(asset: str, date: str, verdict: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"asset": asset, "day": date, "first_us": 0}
    if verdict == "failed":
        return {**entry, "status": "failed", "error": "a damaged Parquet file"}
    return {**entry, "status": "done", "diagnosis": {"verdict": verdict, "summary": verdict, "faults": []}}


def test_a_damaged_newest_file_does_not_hide_the_fault_of_yesterday() -> None:
    days = {
        "a": ("healthy", "fault", "failed"),
        "b": ("healthy", "fault", "undetermined"),
        "c": ("healthy", "fault", "fault"),
        "d": ("fault", "healthy", "failed"),
        "e": ("failed", "failed", "failed"),
        "f": ("fault", "healthy", "undetermined"),
    }
    entries = [day(name, f"2026-01-0{k}", one) for name, told in days.items() for k, one in enumerate(told, 1)]
    fleet = summarise_fleet(entries, {}, {})
    found = {one.asset: (one.day, one.state) for one in fleet.assets}
    assert fleet.count("fault") == 3 and {found[name][1] for name in "abc"} == {"fault"}
    assert found["a"][0] == "2026-01-02"  # and says of which day that is
    assert found["d"] == ("2026-01-03", "failed") and found["f"] == ("2026-01-03", "undetermined")
    assert found["e"][1] == "failed"
    assert len(fleet.failed) == 5  # each is told besides
