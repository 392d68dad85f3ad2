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
from servoscope.service.assets.condition import asset_condition
from servoscope.service.assets.examination import StoredDiagnosis, diagnose_blocks, undetermined
from servoscope.service.assets.examination_schedule import (
    Announcement,
    ExaminationState,
    PendingDiagnosis,
    accept_diagnosis,
    restart_after,
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


def test_a_later_full_diagnosis_that_is_healthy_withdraws_a_fault() -> None:
    ill = examined(ExaminationState(due=0.0), 10.0, FAULT)
    late, early = PendingDiagnosis(1, 0, 20.0, "full"), PendingDiagnosis(1, 0, 5.0, "full")
    gone, _ = accept_diagnosis(ill, late, HEALTHY, first=True, exceeded=False)
    assert (gone.verdict, gone.since, gone.onset, gone.fault_at, gone.faults) == ("healthy", 20.0, None, None, [])
    for window, exceeded in ((late, True), (early, False)):  # the samples still show it, or showed it afterwards
        assert accept_diagnosis(ill, window, HEALTHY, first=True, exceeded=exceeded)[0].verdict == "fault"


def test_after_a_repair_the_samples_since_decide() -> None:
    friction = FaultEstimate(name="friction", parameter="b", ratio=1.37, interval=(1.3, 1.44))
    ill = replace(examined(ExaminationState(due=0.0), 10.0, FAULT), faults=[friction.model_dump(mode="json")])
    assert restart_after(ill, SETTINGS, None) == restart_after(ill, SETTINGS, Announcement("season", 50.0)) == ill
    mended = restart_after(ill, SETTINGS, Announcement("repair", 50.0))
    assert restart_after(mended, SETTINGS, Announcement("repair", 50.0)) is mended  # told again after a restart
    assert (mended.verdict, mended.since, mended.fault_at, mended.faults) == ("undetermined", 50.0, None, [])
    assert mended.window_begin(60.0, SETTINGS.window_s) == 50.0
    assert update_examination(mended, SETTINGS, 100.0, True, pytest.fail)[1] is None  # the recursion remembers it
    resting = examined(mended, 50.0 + SETTINGS.window_s, undetermined("none"))
    assert resting.due <= 50.0 + 2.0 * SETTINGS.window_s  # and not a period later
    for ratio, words in ((1.05, "(friction +5 %, within its scatter)"), (1.12, "not quite as before the fault: ")):
        now = friction.model_copy(update={"ratio": ratio, "interval": (ratio - 0.1, ratio + 0.1)})
        well = examined(mended, 1000.0, HEALTHY.model_copy(update={"size": now}))
        assert well.verdict == "healthy" and words in well.summary


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


def test_after_a_repair_a_leak_has_the_size_that_is_left(leaky: Asset) -> None:
    assert leaky.state is not None
    begin = leaky.state.position.t + 300.0
    leaky.announce(Announcement("repair", leaky.state.position.t))
    status = AssetStatus.model_validate(leaky.status(leaky.state))
    assert status.verdict == "undetermined" and not status.faults
    recorded = halls.recorded(3)
    size = round(0.5 * recorded.sample_rate)
    for k in range(recorded.samples // size):
        rows = slice(k * size, (k + 1) * size)
        t = begin + recorded.t[rows] - recorded.t[0]
        block = Block("press", 1000 + k, np.asarray(t), recorded.r[rows], recorded.u[rows], recorded.y[rows])
        assert not any(one.is_new for one in leaky.process(block).transitions if one.alarm == "fault")
    status = AssetStatus.model_validate(leaky.status(leaky.state))
    assert status.verdict == "healthy" and status.size is not None
    assert status.size.ratio == pytest.approx(1.0, abs=0.02)
    assert "as before the fault (leakage " in status.summary
    assert "as before the fault (leakage " in asset_condition(status).headline


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
