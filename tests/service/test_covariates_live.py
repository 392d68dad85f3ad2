"""Covariates in running services: blocks carry them from file or broker to the store, and whoever resumes has them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brokers import BEGAN, Running, started_broker, until
from commands import run
from halls import RESULTS, asked, service_of
from reliability.servers import Mosquitto

import servoscope as ss
from servoscope.core.errors import MessageError, RecordingError
from servoscope.service import renewal
from servoscope.service.assets.checkpoint import StreamPosition
from servoscope.service.assets.examination import blocks_to_recording
from servoscope.service.assets.status import AssetStatus
from servoscope.service.build import build_assets, build_source
from servoscope.service.config import ServiceFile
from servoscope.service.mqtt import payload
from servoscope.service.mqtt.replay_client import ReplayClient, ReplayClientSettings
from servoscope.service.sources.block import Block
from servoscope.signals import writers
from servoscope.simulation import FaultEvent, reference, simulate
from servoscope.simulation.tutorial import AXIS

LOOP = ss.Loop.from_dict({**AXIS, "columns": {"covariates": {"load": "load"}}})
WEAR = FaultEvent.parse("viscous_friction=2@15")


def carry(load: float, seed: int, *faults: FaultEvent, seconds: float = 20.0) -> ss.Recording:
    """An axis with a load: 10 % of inertia per unit."""
    nominal = LOOP.plant.coefficients  # type: ignore[attr-defined]
    heavier = {**nominal, "inertia": nominal["inertia"] * (1.0 + 0.1 * load)}
    loop = LOOP.model_copy(update={"plant": LOOP.plant.model_copy(update={"coefficients": heavier})})
    r = reference("trapezoid", seconds, loop.sample_rate)
    made, _ = simulate(loop, r, seed=seed, faults=faults, noise_u_std=5e-3, noise_y_std=1e-5)
    return replace(made, channels={"load": np.full(made.samples, load)}, name=f"load-{load:g}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with baseline.json, and healthy.csv and worn.csv under loads that nobody has learned."""
    made = tmp_path_factory.mktemp("hall")
    ss.learn(LOOP, [carry(load, i) for i, load in enumerate((1.0, 3.0, 5.0))]).save(made / "baseline.json")
    writers.write_recording(made / "healthy.csv", carry(2.0, 8), LOOP.columns)
    writers.write_recording(made / "worn.csv", carry(4.0, 9, WEAR, seconds=30.0), LOOP.columns)
    return made


def hall(folder: Path, name: str, source: str, more: str = "") -> Path:
    path = folder / f"{name}.toml"
    path.write_text(
        f'name = "hall"\n[service]\nlisten = ""\ncommit_every_s = 0.01\nlog = "error"\n'
        f'[store]\nurl = "{name}.sqlite"\nresidual_every_s = 2.0\n'
        f'[diagnosis]\nwindow_s = 20.0\nevery_s = 10.0\n[sources.line]\n{source}\n[assets.axis]\nsource = "line"\n'
        f'baseline = "baseline.json"\n{more}\n',
        encoding="utf-8",
    )
    return path


def replayed(folder: Path, name: str, speed: float = 0.0) -> Path:
    source = f'kind = "replay"\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\nspeed = {speed}'
    return hall(folder, name, source, 'files = ["healthy.csv", "worn.csv"]')


@pytest.fixture(scope="module")
def whole(folder: Path) -> dict[str, list[object]]:
    """What an uninterrupted run leaves behind."""
    config = replayed(folder, "whole")
    service_of(config).run()
    return {name: asked(config, query) for name, query in RESULTS.items()}


def test_loads_never_learned_are_healthy_and_wear_beside_them_is_told(
    folder: Path, whole: dict[str, list[object]]
) -> None:
    verdicts = asked(folder / "whole.toml", "SELECT t, grounds, verdict, summary FROM diagnoses ORDER BY t, number")
    end_of_healthy = BEGAN + 20.0
    assert {verdict for t, _, verdict, _ in verdicts if t < end_of_healthy} <= {"healthy", "undetermined"}
    assert any(verdict == "fault" and "viscous" in said for t, _, verdict, said in verdicts if t > end_of_healthy + 15)
    raised = asked(
        folder / "whole.toml", "SELECT t FROM transitions WHERE after = 'unacknowledged' AND alarm = 'fault'"
    )
    assert raised and raised[0][0] > end_of_healthy + 15.0


@pytest.mark.slow
def test_a_service_that_is_stopped_goes_on_with_the_same_bits(folder: Path, whole: dict[str, list[object]]) -> None:
    config = replayed(folder, "cut", speed=2.0)
    running = Running(service_of(config))
    until(lambda: asked(config, "SELECT count(*) FROM recent")[0][0] > 2)
    running.end(stop=True)
    assert asked(config, "SELECT max(sequence) FROM recent")[0][0] < 99
    service_of(replayed(folder, "cut")).run()
    for name, query in RESULTS.items():
        assert asked(config, query) == whole[name], name


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    server = started_broker(tmp_path)
    yield server
    server.stop()


@pytest.mark.parametrize("form", ["binary", "json"])
def test_over_a_broker_the_same_arrives(
    folder: Path, broker: Mosquitto, whole: dict[str, list[object]], form: str
) -> None:
    config = hall(folder, f"broker-{form}", f'kind = "mqtt"\nhost = "127.0.0.1"\nport = {broker.port}')
    service = service_of(config)
    running = Running(service)
    (folder / "loop.toml").write_text(json_to_toml(LOOP.to_dict()), encoding="utf-8")
    (folder / "publish.toml").write_text(
        f'again_s = 0.5\nformat = "{form}"\n[replay]\nspeed = 0.0\nblock = 0.5\nstart = 2026-01-01T00:00:00Z\n'
        f'[broker]\nhost = "127.0.0.1"\nport = {broker.port}\n'
        '[assets.axis]\nloop = "loop.toml"\nfiles = ["healthy.csv", "worn.csv"]\n',
        encoding="utf-8",
    )
    try:
        ReplayClient(ReplayClientSettings.load(folder / "publish.toml")).run()
        until(lambda: asked(config, "SELECT max(sequence) FROM recent")[0][0] == whole["recent"][-1][1])
    finally:
        running.end(stop=True)
    # how many old blocks are kept depends on whether the last diagnosis has ended
    assert set(whole["recent"]) <= set(asked(config, RESULTS["recent"]))
    assert whole["residuals"] and asked(config, RESULTS["residuals"]) == whole["residuals"]


def json_to_toml(plain: dict[str, object]) -> str:
    """Tables of scalars and lists, nested: what a loop file holds."""

    def write(table: dict[str, object], path: tuple[str, ...]) -> str:
        own = "".join(f"{k} = {json.dumps(v)}\n" for k, v in table.items() if not isinstance(v, dict) and v is not None)
        inner = "".join(write(v, (*path, k)) for k, v in table.items() if isinstance(v, dict))
        return (f"[{'.'.join(path)}]\n" if path else "") + own + inner

    return write(plain, ())


def block(n: int = 4) -> Block:
    t, rows = BEGAN + 0.01 * np.arange(n), np.arange(5.0 * n).reshape(5, n)
    return Block("axis", 7, t, *rows[:3], covariates=rows[3:])


def test_packed_blocks_tell_their_columns_themselves() -> None:
    for n in (1, 2, 8):
        one = block(n)
        again = Block.unpack("axis", 7, one.pack())
        np.testing.assert_array_equal(again.signals, one.signals)
        plain = replace(one, covariates=np.zeros((0, 0)))
        assert len(plain.pack()) == 32 * n  # as earlier versions wrote them
        assert Block.unpack("axis", 7, plain.pack()).covariates.shape[0] == 0
    with pytest.raises(RecordingError, match="is torn"):
        Block.unpack("axis", 7, block().pack()[:-9] + b"\x02")


def test_messages_carry_the_columns_that_the_loop_names() -> None:
    one, names = block(), ("load", "oil")
    for message in (payload.encode_binary(one), payload.encode_json(one, covariates=names)):
        found = payload.decode_block("axis", message, covariates=names)
        np.testing.assert_array_equal(found.signals, one.signals)
        assert len(payload.decode_block("axis", message).covariates) == 0  # nobody wants them
    for message in (
        payload.encode_binary(replace(one, covariates=one.covariates[:1])),
        payload.encode_json(replace(one, covariates=one.covariates[:1]), covariates=names[:1]),
        payload.encode_json(replace(one, covariates=np.zeros((0, 0)))),
    ):
        with pytest.raises(MessageError, match="expected load, oil"):
            payload.decode_block("axis", message, covariates=names)
    swapped = json.loads(payload.encode_json(one, covariates=names))
    swapped["covariates"] = dict(reversed(swapped["covariates"].items()))
    found = payload.decode_block("axis", json.dumps(swapped).encode(), covariates=names)
    np.testing.assert_array_equal(found.signals, one.signals)


def test_a_slow_thermometer_holds_its_last_value_where_blocks_are_examined(folder: Path) -> None:
    baseline, made = ss.Baseline.load(folder / "baseline.json"), carry(2.0, 8)
    slow = np.where(np.arange(made.samples) % 100 == 30, 2.0, np.nan)
    one = Block("axis", 0, BEGAN + made.t, made.r, made.u, made.y, covariates=slow[None])
    recording, _ = blocks_to_recording(baseline, "axis", [one])
    assert recording.samples == made.samples
    assert (recording.channels["load"] == 2.0).all()


def test_a_thermometer_that_is_dead_takes_no_other_value(folder: Path) -> None:
    baseline, one = ss.Baseline.load(folder / "baseline.json"), block(100)
    one = replace(one, t=BEGAN + 0.005 * np.arange(100))
    assert baseline.covariates is not None
    both = baseline.covariates.model_copy(update={"names": ("oil", "load")})
    dead = np.stack([np.full(100, np.nan), np.full(100, 2.0)])
    both = baseline.model_copy(update={"covariates": both})  # type: ignore[assignment]
    with pytest.raises(RecordingError, match="oil has had no new value for more than 600 s"):
        blocks_to_recording(both, "axis", [replace(one, covariates=dead)])  # type: ignore[arg-type]


def test_the_baseline_of_one_load_needs_no_column_in_blocks(folder: Path) -> None:
    # as before sources carried covariates: its senders have none, and the store holds blocks without
    baseline = ss.Baseline.load(folder / "baseline.json")
    for name, one, count in (("all", baseline, 1), ("one", baseline.at({"load": 2.0}), 0)):
        one.save(folder / f"{name}.json")
        path = replayed(folder, name)
        path.write_text(path.read_text(encoding="utf-8").replace("baseline.json", f"{name}.json"), encoding="utf-8")
        config = ServiceFile.load(path)
        source = build_source(config, build_assets(config), "line")
        source.open({})
        assert [len(made.covariates) for made in source.poll(1)] == [count]


def test_a_source_that_carries_none_refuses(folder: Path) -> None:
    source = 'kind = "mqtt"\nhost = "127.0.0.1"\n[sources.line.payload]\nform = "sparkplug"'
    told = run("run", hall(folder, "plant", source), "--check")
    assert told.code == 1
    assert "depends on load, which source line does not carry" in told.err


def test_recordings_of_what_a_baseline_does_not_hold_are_asked_for(folder: Path) -> None:
    loads = ss.Baseline.load(folder / "baseline.json")
    alone = loads.model_copy(update={"covariates": None})

    def offers(verdict: str, baseline: ss.Baseline) -> list[str]:
        position = StreamPosition(began=0.0, t=7200.0)
        status = AssetStatus.model_construct(verdict=verdict, since=0.0, position=position, learning=None)
        return [str(offer) for offer in renewal.offers(baseline, status, 3600.0)]

    asked_for = "The baseline holds load from 1 to 5: healthy recordings beyond that range are missing."
    assert offers("undetermined", loads) == [asked_for]
    assert offers("undetermined", alone) == offers("fault", loads) == []
    assert offers("healthy", loads)[-1] == asked_for
    assert "60 min" in offers("healthy", alone)[0]
