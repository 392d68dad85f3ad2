"""Diagnoses of arms: a simulated one whose loop reacts to what changes, and measured ones."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.ndimage import uniform_filter1d
from typer.testing import CliRunner

from servoscope.arm.baseline import ArmBaseline
from servoscope.arm.diagnosis import diagnose_arm, examine_arm
from servoscope.arm.learning import learn_arm
from servoscope.arm.log import ArmRecording, read_arm_log
from servoscope.arm.page import render_arm_page
from servoscope.arm.regression import filter_arm_log
from servoscope.arm.settings import ArmLoop
from servoscope.arm.setup import calibrate_load
from servoscope.arm.simulation import (
    GAINS,
    URDF,
    ArmChange,
    simulate_arm,
    simulated_arm,
    simulated_arm_loop,
)
from servoscope.arm.urdf import parse_urdf
from servoscope.baseline.baseline import Baseline
from servoscope.cli import app
from servoscope.core.errors import BaselineError, LoopError, NotEnoughError, RecordingError
from servoscope.core.messages import set_language

UR_GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)
UR_DAYS = ("20_02_05", "20_02_06", "20_02_10")
UR_HELD_OUT = (
    "identification_data__ur-19_12_23_free",
    "validation_data__ur-20_01_17-ptp_10_points",
    "jointwise_motion__ur-20_01_22-joint_3",
    "identification_data__ur-20_02_12-40sec_12harm",
    "identification_data__ur-20_02_12-50sec_12harm",
    "identification_data__ur-20_02_19_14harm50sec",
    "identification_data__ur-20_02_19_15harm50sec",
)

pytestmark = pytest.mark.slow  # each simulates or reads minutes of six joints

Read = Callable[[int, ArmChange | None], ArmRecording]


@pytest.fixture(scope="module")
def simulated() -> tuple[ArmBaseline, Read]:
    arm, urdf, loop = simulated_arm(), URDF.read_text(encoding="utf-8"), simulated_arm_loop()

    def record(seed: int, change: ArmChange | None = None) -> ArmRecording:
        return read_arm_log(simulate_arm(seed, 30.0, change), loop, arm)

    return learn_arm(loop, urdf, [record(seed) for seed in range(3)]), record


def test_a_simulated_arm(simulated: tuple[ArmBaseline, Read], tmp_path: Path) -> None:
    baseline, record = simulated
    assert diagnose_arm(baseline, record(20, None)).verdict == "healthy"
    diagnosis, examination = examine_arm(baseline, record(21, ArmChange("friction", 1.5, 3, 15.0)))
    (fault,) = diagnosis.faults
    assert (fault.name, fault.parameter) == ("friction of elbow", "elbow.coulomb_friction")
    assert fault.ratio == pytest.approx(1.5, abs=0.15)
    assert diagnosis.onset_s is not None and diagnosis.onset_s[1] == pytest.approx(15.0, abs=0.5)
    page = render_arm_page(diagnosis, examination, baseline)
    assert "friction of elbow" in page and page.count("<h2>The arm and its joints</h2>") == 1
    set_language("de")
    try:
        words = re.sub(r"<(style|svg|code).*?</\1>", "", render_arm_page(diagnosis, examination, baseline), flags=re.S)
    finally:
        set_language("en")
    assert "Reibung von elbow" in words
    assert re.findall(r">[^<]*\b(?:the|of|with|friction|fault|since|baseline|recordings?)\b[^<]*<", words) == []
    loaded = diagnose_arm(baseline, record(22, ArmChange("payload", 2.0, 6, 15.0)))
    assert loaded.verdict == "healthy" and loaded.faults[0].mass_kg is not None
    assert loaded.faults[0].mass_kg[0] == pytest.approx(2.0, abs=0.3)
    baseline.save(tmp_path / "arm.json")
    assert ArmBaseline.load(tmp_path / "arm.json") == baseline
    text = (tmp_path / "arm.json").read_text()
    (tmp_path / "first.json").write_text(text.replace('"version": 2', '"version": 1'))
    first = ArmBaseline.load(tmp_path / "first.json")
    assert first is not None and first.loop.curve_speed == 0.0  # the friction of version 1 is a straight line
    with pytest.raises(BaselineError, match="baseline of kind 'arm'"):
        Baseline.load(tmp_path / "arm.json")


def test_a_push_is_an_event(simulated: tuple[ArmBaseline, Read]) -> None:
    baseline, record = simulated
    recording = record(23, None)
    torque = recording.torque.copy()
    torque[1500:1550, 1] += 60.0
    diagnosis = diagnose_arm(baseline, replace(recording, torque=torque))
    assert diagnosis.verdict == "healthy" and "push or collision" in diagnosis.summary
    (event,) = [each for each in diagnosis.warnings if each.kind == "event"]
    assert event.from_s == pytest.approx(15.0, abs=0.5) and "shoulder" in event.message
    target = recording.q + 0.1 * (recording.t > 15.2)[:, None]
    jumped = diagnose_arm(baseline, replace(recording, torque=torque, target=target))
    assert [each.message[:30] for each in jumped.warnings if each.kind == "event"] == ["a jump of the target position:"]


def test_closed_brakes_are_no_event(simulated: tuple[ArmBaseline, Read]) -> None:
    """The arm pauses for 5 s, in which brakes hold it for 3 s and the drives give no torque."""
    baseline, record = simulated
    recording = record(23, None)
    speed = np.interp(recording.t, [10.0, 10.5, 15.5, 16.0], [1.0, 0.0, 0.0, 1.0])
    passed = np.cumsum(speed) / recording.sample_rate
    q = np.column_stack([np.interp(passed, recording.t, own) for own in recording.q.T])
    signals = filter_arm_log(replace(recording, q=q), baseline.model)
    expected = np.einsum("jpm,p->jm", baseline.design(signals), np.array(baseline.theta))
    torque = np.column_stack([np.interp(recording.t, signals.t, own) for own in expected])
    assert np.abs(torque[1300]).max() > 5.0  # N m of weight
    torque[1150:1450] = 0.0
    diagnosis = diagnose_arm(baseline, replace(recording, q=q, torque=torque))
    assert diagnosis.verdict == "healthy" and [each.kind for each in diagnosis.warnings] == []


def test_a_logged_velocity_is_used_where_it_is_the_better_one(simulated: tuple[ArmBaseline, Read]) -> None:
    baseline, record = simulated
    recording = record(23, None)
    v = np.gradient(recording.q, 0.01, axis=0)
    joints = {name: {**joint.model_dump(), "velocity": f"v{name}"} for name, joint in baseline.loop.joints.items()}
    loop = ArmLoop.from_dict(baseline.loop.model_dump() | {"joints": joints}, "arm.toml")
    for velocity, words in (
        (uniform_filter1d(v, 5, axis=0), "velocities are used"),
        (v + 1e-2 * np.sin(v * 1e4), "left out"),
    ):
        learned = learn_arm(loop, baseline.urdf, [replace(recording, velocity=velocity)])
        assert words in str(learned.notes[0])
        assert (learned.loop.joints["elbow"].velocity is None) == (words == "left out")
    with pytest.raises(RecordingError, match=r"is 57\.3 times the derivative of its position"):
        learn_arm(loop, baseline.urdf, [replace(recording, velocity=np.degrees(v))])
    del joints["elbow"]["velocity"]
    with pytest.raises(LoopError, match="velocity must be given of all joints, or of none"):
        ArmLoop.from_dict(baseline.loop.model_dump() | {"joints": joints}, "arm.toml")


def test_an_arm_at_rest_is_undetermined(simulated: tuple[ArmBaseline, Read]) -> None:
    baseline, record = simulated
    recording = record(23, None)
    still = replace(recording, q=np.broadcast_to(recording.q[:1], recording.q.shape))
    still = replace(still, torque=np.broadcast_to(recording.torque[:1], recording.torque.shape))
    assert diagnose_arm(baseline, still).verdict == "undetermined"
    with pytest.raises(NotEnoughError, match=r"base_yaw: moves for 0\.0 s"):
        learn_arm(baseline.loop, baseline.urdf, [still])


def test_a_reversed_torque_is_refused(simulated: tuple[ArmBaseline, Read]) -> None:
    baseline, record = simulated
    recording = record(23, None)
    reversed_sign = recording.torque * np.array([1, 1, -1, 1, 1, 1])
    with pytest.raises(RecordingError, match="its friction comes out negative"):
        learn_arm(baseline.loop, baseline.urdf, [replace(recording, torque=reversed_sign)])


@pytest.fixture(scope="module")
def ur10e(shared_data: Path) -> tuple[ArmBaseline, Callable[[str], ArmRecording]]:
    folder = shared_data / "real" / "ur10e"
    urdf = (folder / "ur10e.urdf").read_text(encoding="utf-8")
    arm = parse_urdf(urdf, "ur10e.urdf")
    joints = {
        name: {"position": f"q{j + 1}", "torque": f"i{j + 1}", "gain": UR_GAINS[j]} for j, name in enumerate(arm.names)
    }
    loop = ArmLoop.from_dict({"kind": "arm", "urdf": "x", "sample_rate": 100.0, "joints": joints}, "arm.toml")

    def record(name: str) -> ArmRecording:
        return read_arm_log(folder / f"{name}.parquet", loop, arm)

    days = sorted(path.stem for path in folder.glob("*.parquet") if any(day in path.stem for day in UR_DAYS))
    return learn_arm(loop, urdf, [record(name) for name in days]), record


def test_healthy_recordings_of_other_days(ur10e: tuple[ArmBaseline, Callable[[str], ArmRecording]]) -> None:
    baseline, record = ur10e
    verdicts = {name: diagnose_arm(baseline, record(name)) for name in UR_HELD_OUT}
    assert {name: each.summary for name, each in verdicts.items() if each.verdict != "healthy" or each.intervals} == {}


def test_a_payload_and_a_push(ur10e: tuple[ArmBaseline, Callable[[str], ArmRecording]]) -> None:
    baseline, record = ur10e
    for name in ("14harm50secLoad", "15harm50secLoad"):
        diagnosis = diagnose_arm(baseline, record(f"identification_data__ur-20_02_19_{name}"))
        assert diagnosis.verdict == "healthy" and "the payload changed" in diagnosis.summary
        (fault,) = diagnosis.faults
        assert fault.mass_kg is not None and fault.mass_kg[1] < 2.805 < fault.mass_kg[2]
        assert fault.mass_kg[0] == pytest.approx(2.805, rel=0.1)
    pushed = diagnose_arm(baseline, record("collision__ur-20_01_22-push_pose_1"))
    assert pushed.verdict == "undetermined" and "It was pushed" in pushed.summary


def test_friction_is_found_in_its_joint(ur10e: tuple[ArmBaseline, Callable[[str], ArmRecording]]) -> None:
    """Coulomb friction of each joint grows by 30 % or 10 % in the middle of a recording of another day."""
    from scipy.signal import butter, sosfiltfilt

    baseline, record = ur10e
    recording = record("identification_data__ur-20_02_12-50sec_12harm")
    smooth = sosfiltfilt(butter(3, 10.0, fs=100.0, output="sos"), recording.q, axis=0)
    v, late = np.gradient(smooth, 0.01, axis=0), np.arange(len(smooth)) >= len(smooth) // 2
    found = {0.3: 0, 0.1: 0}
    for growth in found:
        for j, name in enumerate(baseline.model.arm.names):
            torque = recording.torque.copy()
            coulomb = baseline.coefficient(f"{name}.coulomb_friction")[0]
            torque[:, j] += growth * coulomb * np.tanh(v[:, j] / 0.01) * late
            for fault in diagnose_arm(baseline, replace(recording, torque=torque)).faults:
                assert fault.parameter.startswith(f"{name}.") and fault.name == f"friction of {name}"
                found[growth] += fault.interval[0] < 1.0 + growth < fault.interval[1]
    assert found[0.3] == 6 and found[0.1] >= 4


def test_the_published_friction_of_a_tx40(shared_data: Path) -> None:
    """TX40_config.yaml of figaroh-examples: fv and fs; what the wrist's motor adds to both its joints counts."""
    folder = shared_data / "real" / "tx40"
    urdf = (folder / "tx40_mdh_modified.urdf").read_text(encoding="utf-8")
    arm = parse_urdf(urdf, "tx40.urdf")
    gears = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    gears[5, 4] = 32.0
    offsets = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0)
    joints = {
        name: {"position": f"q{j + 1}_raw", "torque": f"current{j + 1}_raw", "offset": offsets[j]}
        for j, name in enumerate(arm.names)
    }
    table = {"kind": "arm", "urdf": "x", "sample_rate": 1000.0, "cutoff": 30.0, "sign_speed": 0.02, "joints": joints}
    loop = ArmLoop.from_dict({**table, "load_friction": False, "curve_speed": 0.0, "gears": gears.tolist()}, "arm.toml")
    time = pq.read_schema(folder / "tx40.parquet").names[0]
    loop = loop.model_copy(update={"time": time})
    baseline = learn_arm(loop, urdf, [read_arm_log(folder / "tx40.parquet", loop, arm)])

    def friction(what: str) -> np.ndarray:
        return np.array([baseline.coefficient(f"{name}.{what}_friction")[0] for name in arm.names])

    viscous = friction("viscous") + baseline.coefficient("motor1.viscous_friction")[0] * np.array([0, 0, 0, 0, 1, 1])
    assert np.abs(viscous / [8.05, 5.53, 1.97, 1.11, 1.86, 0.65] - 1.0)[:5].max() < 0.015
    assert np.abs(friction("coulomb") / [7.14, 8.26, 6.34, 2.48, 3.03, 0.282] - 1.0)[:5].max() < 0.02


JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_bag(path: Path) -> None:
    """Write a log beside itself as /joint_states of ROS 2: joints by the alphabet, a gripper's own messages between."""
    from mcap_ros2.writer import Writer

    names = simulated_arm().names
    order = np.argsort(names)
    log = np.loadtxt(path, delimiter=",", skiprows=1)
    q, effort = log[:, 1:7][:, order], (log[:, 7:] * GAINS)[:, order]
    velocity = np.gradient(q, log[:, 0], axis=0)
    with path.with_suffix(".mcap").open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for k, t in enumerate(log[:, 0]):
            own = {"name": [names[j] for j in order]}
            own |= {what: x[k].tolist() for what, x in (("position", q), ("velocity", velocity), ("effort", effort))}
            gripper = {"name": ["finger"], "position": [0.04], "velocity": [0.0], "effort": [1.0]}
            for late, message in ((0, own), (2_000_000, gripper))[: 1 + (k % 4 == 0)]:
                ns = round(1e9 * t) + 1_700_000_000_000_000_000 + late
                header = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": ""}
                writer.write_message("/joint_states", schema, {"header": header, **message}, log_time=ns)
        writer.finish()


def test_the_commands_take_an_arm(tmp_path: Path) -> None:
    """From the bags of a robot with ROS 2."""
    from servoscope.arm.simulation import write_example

    write_example(tmp_path)
    for name in ("day1", "day2", "day3", "tuesday", "pallet", "load"):
        write_bag(tmp_path / f"{name}.csv")
    days = [str(tmp_path / f"day{day}.mcap") for day in (1, 2, 3)]
    run = CliRunner().invoke
    proposed = run(
        app, ["init", days[0], "--urdf", str(tmp_path / "six_joints.urdf"), "-o", str(tmp_path / "own.toml")]
    )
    assert proposed.exit_code == 0, proposed.output
    assert ArmLoop.load(tmp_path / "own.toml")[0].joints["elbow"].torque == "`effort[elbow]`"
    learned = run(app, ["learn", str(tmp_path / "own.toml"), *days, "-o", str(tmp_path / "arm.json")])
    assert learned.exit_code == 0 and "base_yaw" in learned.output, learned.output
    logs = [str(tmp_path / "tuesday.mcap"), str(tmp_path / "pallet.mcap")]
    told = run(app, ["diagnose", str(tmp_path / "arm.json"), *logs])
    assert told.exit_code == 3, told.output
    assert "friction of elbow" in told.output and "the payload changed" in told.output
    load, to = str(tmp_path / "load.mcap"), str(tmp_path / "c.toml")
    calibrated = run(app, ["calibrate-load", str(tmp_path / "arm.json"), load, "--mass", "5", "-o", to])
    assert calibrated.exit_code == 0 and "flange_roll: it stays" in " ".join(calibrated.output.split())
    loop, _ = ArmLoop.load(tmp_path / "c.toml")
    gain = loop.joints["base_yaw"].gain  # of efforts in N m; the load determines it within 0.2
    assert loop.gains == "load" and gain != 1.0 and gain == pytest.approx(1.0, abs=0.4)
    refused = run(app, ["diagnose", str(tmp_path / "arm.json"), *logs, "--from", "3"])
    assert refused.exit_code == 2 and "no meaning for kind 'arm'" in refused.output


def test_a_load_of_known_mass_gives_the_drive_gains(ur10e: tuple[ArmBaseline, Callable[[str], ArmRecording]]) -> None:
    """One pair of logs calibrates, the other is judged: without and with 2.805 kg."""
    baseline, record = ur10e
    gains = calibrate_load(baseline, record("identification_data__ur-20_02_19_14harm50secLoad"), 2.805)
    assert max(gains, key=lambda gain: gain.std).joint == "shoulder_pan_joint"  # the load has no weight about it
    assert [gain.joint for gain in gains if not gain.determined] == []
    joints = {
        gain.joint: baseline.loop.joints[gain.joint].model_copy(update={"gain": gain.gain} if gain.determined else {})
        for gain in gains
    }
    loop = baseline.loop.model_copy(update={"joints": joints, "gains": "load"})
    ratio = np.array([joints[name].gain / joint.gain for name, joint in baseline.loop.joints.items()])

    def scaled(name: str) -> ArmRecording:
        recording = record(name)
        return replace(recording, torque=recording.torque * ratio)

    names = [source.name.removesuffix(".parquet") for source in baseline.sources]
    calibrated = learn_arm(loop, baseline.urdf, [scaled(name) for name in names])
    diagnosis = diagnose_arm(calibrated, scaled("identification_data__ur-20_02_19_15harm50secLoad"))
    assert diagnosis.verdict == "healthy" and not diagnosis.warnings
    (fault,) = diagnosis.faults
    assert fault.mass_kg is not None and fault.mass_kg[1] < 2.805 < fault.mass_kg[2]
    assert fault.mass_kg[0] == pytest.approx(2.805, rel=0.1)
