"""The verdict of one log as an alarm of the service, for assets whose control itself may be what is wrong."""

from __future__ import annotations

import halls
import numpy as np
from test_assess import N, loop

from servoscope.core.messages import speak
from servoscope.diagnosis.monitor import Monitor
from servoscope.service.alarms import AlarmSettings
from servoscope.service.alarms.conditions import AssetSnapshot, describe_cause, evaluate_condition
from servoscope.service.assets.asset import Asset, AssetPolicy
from servoscope.service.assets.checkpoint import pack_state, unpack_state
from servoscope.service.config import DiagnosisSettings
from servoscope.service.sources.block import Block
from servoscope.signals.quality import QualitySettings

BEGAN = 1767225600.0
ALARMS = AlarmSettings.model_validate({"control": {"source": "control", "operator_action": "test the valve"}})
SECONDS = 12


def followed(log: dict[str, np.ndarray], alarms: AlarmSettings) -> tuple[Asset, list[str]]:
    """Follow a log in blocks of a second; the names of alarms that occur."""
    policy = AssetPolicy(DiagnosisSettings(window_s=12.0, every_s=1.0), QualitySettings(window_s=2.0), alarms, 60.0)
    baseline = halls.baseline()
    asset, rate = Asset("press", baseline, Monitor(baseline), policy), baseline.loop.sample_rate
    size, occurred = round(rate), []
    for k in range(min(SECONDS, N // size)):
        rows = slice(k * size, (k + 1) * size)
        t = BEGAN + np.arange(rows.start, rows.stop) / rate
        result = asset.process(Block("press", k, t, log["r"][rows], log["u"][rows], log["y"][rows]))
        occurred += [one.alarm for one in result.transitions if one.is_new]
    return asset, occurred


def test_a_sticking_valve_is_an_alarm_where_one_is_defined() -> None:
    asset, occurred = followed(loop(21, stick=4.0), ALARMS)
    assert "control" in occurred
    assert asset.state is not None
    kept = unpack_state(pack_state(asset.state), "press")
    assert kept.examination.control == "stiction"
    assert kept.alarms["control"].cause == "the last minutes show stiction"
    _, without = followed(loop(21, stick=4.0), AlarmSettings())
    assert "control" not in without


def test_what_was_not_assessed_is_neither_normal_nor_abnormal() -> None:
    definition = ALARMS.definitions["control"]
    for control, condition in ((None, "unknown"), ("", "normal"), ("stiction", "abnormal"), ("good", "normal")):
        assert evaluate_condition(definition, False, AssetSnapshot(control=control)) == condition
    with speak("de"):
        assert "Haftreibung" in describe_cause(definition, AssetSnapshot(control="stiction"))
