"""Until which size a loop does its work: limits of faults, against loops that are simulated sample by sample."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import halls
import numpy as np
import pytest
from typer.testing import CliRunner

from servoscope.cli import app
from servoscope.core.errors import ConfigError
from servoscope.design.operating_limits import BANDWIDTH_LEFT, operating_limits
from servoscope.models.loop import Loop
from servoscope.service.assets.outlook import DuePrognosis
from servoscope.service.build import build_visit
from servoscope.service.config import ServiceFile
from servoscope.service.diagnosis_worker import find_due_prognosis
from servoscope.service.sources.block import Block
from servoscope.service.store import Batch, Store
from servoscope.simulation.stability import closed_loop_poles


@cache
def limits() -> dict[tuple[str, str], tuple[float | None, float | None]]:
    return {(one.fault, one.kind): (one.up, one.down) for one in operating_limits(Loop.load(halls.LOOP))}


def error_share(loop: Loop, gain: float, frequency: float) -> float:
    """Return the tracking error of a sine, as a share of it, by stepping through the continuous plant."""
    A, B, C = loop.plant.with_ratios({"p_s": gain}).state_space()
    T, fine = 1.0 / loop.sample_rate, 200  # steps of the plant per sample
    step = np.eye(A.shape[0]) + A * T / fine  # Euler
    x, total, errors = np.zeros(A.shape[0]), 0.0, []
    for k in range(round(6.0 / T)):
        e = math.sin(2.0 * math.pi * frequency * k * T) - float((C @ x)[0])
        total += loop.controller.k_i * T * e
        u = loop.controller.k_p * e + total
        for _ in range(fine):
            x = step @ x + B[:, 0] * u * T / fine
        errors.append(e)
    return math.sqrt(2.0 * float(np.mean(np.square(errors[len(errors) // 2 :]))))


def test_only_what_moves_the_loop_has_a_limit() -> None:
    """An integrating controller makes up for a leak; a weak pump makes the loop slow, and soft oil makes it swing."""
    found = limits()
    assert found["leakage", "tracking"] == found["leakage", "stability"] == (None, None)
    assert found["pump", "tracking"][1] == pytest.approx(0.41, abs=0.01)
    assert found["contamination", "stability"][1] == pytest.approx(0.186, abs=0.005)


def test_the_bandwidth_is_lost_where_a_simulated_sine_says_so() -> None:
    """Up to the bandwidth the error stays below 0.707 of the reference: 9.26 Hz healthy, 0.7 of it at the limit."""
    loop = Loop.load(halls.LOOP)
    healthy = 9.26
    assert error_share(loop, 1.0, healthy) == pytest.approx(math.sqrt(0.5), rel=0.03)
    gain = limits()["pump", "tracking"][1]
    assert gain is not None
    assert error_share(loop, gain, BANDWIDTH_LEFT * healthy) == pytest.approx(math.sqrt(0.5), rel=0.03)


def test_half_the_margin_leaves_so_much_less_gain() -> None:
    """A distance d of L from -1 lets the gain grow by 1 / (1 - d) at least; poles say how far it really may."""
    loop, ratio = Loop.load(halls.LOOP), limits()["contamination", "stability"][1]
    assert ratio is not None and loop.controller is not None

    def gain_margin(size: float) -> float:
        plant, own = loop.plant.with_ratios({"beta": size}), loop.controller
        for gain in np.geomspace(1.0, 20.0, 300):
            controller = own.model_copy(update={"k_p": gain * own.k_p, "k_i": gain * own.k_i})
            if np.abs(closed_loop_poles(loop.model_copy(update={"controller": controller}), plant)).max() >= 1.0:
                return float(gain)
        return math.inf

    assert 1.0 / (1.0 - 0.5 * 0.62) - 0.02 < gain_margin(ratio) < 0.7 * gain_margin(1.0)


def test_a_service_file_names_what_the_loop_loses_and_trend_takes_its_loop(tmp_path: Path) -> None:
    """A weak pump slows the loop down; a stronger one has no limit, and a leak none at all."""
    halls.files(tmp_path)
    named = 'limits = { pump = "tracking", leakage = 1.5 }'
    path = halls.hall(tmp_path, "hall", more=named)
    assets, _ = build_visit(ServiceFile.load(path))
    assert assets["press"].policy.limits == {}
    asset = assets["lift"]
    asset.process(Block("lift", 0, np.arange(100) / 100.0, *np.zeros((3, 100))))
    assert asset.state is not None
    for fault, ratio, limit in (("pump", 0.8, 0.41), ("pump", 1.2, None), ("leakage", 1.2, 1.5), ("leakage", 0.9, 1.5)):
        examination = replace(asset.state.examination, faults=[{"name": fault, "ratio": ratio}], onset=7.0)
        due = find_due_prognosis(replace(asset.state, examination=examination), asset.policy.limits, 3600.0)
        assert due == (None if limit is None else DuePrognosis(fault, limit, 7.0))
    halls.hall(tmp_path, "hall", more='limits = { leakage = "stability" }')
    with pytest.raises(ConfigError, match=r"limits of lift: .* no size of leakage takes that from this loop"):
        build_visit(ServiceFile.load(path))
    halls.hall(tmp_path, "hall", more='limits = { leakage = "stabilty" }')
    with pytest.raises(ConfigError, match="'stabilty': give a number, tracking or stability"):
        ServiceFile.load(path)

    halls.hall(tmp_path, "hall", more=named)
    store, batch = Store.open("hall.sqlite", tmp_path, write=True), Batch()
    batch.checkpoints["lift"] = {"asset": "lift", "sequence": 0, "state": b"", "status": {}, "at": 0.0}
    sizes = [0.95 - 0.003 * day + 0.002 * (-1) ** day for day in range(60)]
    ends = {"kind": "live", "name": "pump", "healthy": 1.0}
    batch.rows["sizes"] = [
        {"asset": "lift", "t": 86400.0 * day, "value": x, "low": x - 0.006, "high": x + 0.006, **ends}
        for day, x in enumerate(sizes)
    ]
    store.write(batch, "hall", 1)
    store.close()
    shown = CliRunner().invoke(app, ["trend", str(path), "--asset", "lift", "--limit", "tracking"])
    assert shown.exit_code == 0 and "pump reaches 0.41 in" in " ".join(shown.output.split())


def test_a_forecast_goes_to_the_limit_of_the_loop(tmp_path: Path) -> None:
    rows = [f"{86400 * day},{1.0 - 0.004 * day + 0.002 * (-1) ** day},0.003" for day in range(60)]
    sizes = tmp_path / "sizes.csv"
    sizes.write_text("\n".join(["time,pump,std", *rows]))
    arguments = ["trend", str(sizes), "--value", "pump", "--std", "std", "--limit"]
    shown = CliRunner().invoke(app, [*arguments, "tracking", "--loop", str(halls.LOOP)])
    assert shown.exit_code == 0 and "pump reaches 0.41 in" in " ".join(shown.output.split())
    shown = CliRunner().invoke(app, [*arguments, "stability", "--loop", str(halls.LOOP)])
    assert shown.exit_code == 2 and "does not take it from this loop" in " ".join(shown.output.split())
    assert "give the loop file" in " ".join(CliRunner().invoke(app, [*arguments, "tracking"]).output.split())
