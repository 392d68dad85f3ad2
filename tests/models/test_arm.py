"""The URDF reader and the regressor of an arm, compared with Pinocchio's numbers and with energies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from servoscope.arm.dynamics import torque_regressor
from servoscope.arm.log import read_arm_log
from servoscope.arm.model import ArmModel
from servoscope.arm.settings import ArmLoop
from servoscope.arm.setup import propose_arm_loop
from servoscope.arm.simulation import GAINS, URDF, simulated_arm
from servoscope.arm.urdf import parse_urdf
from servoscope.core.errors import LoopError, RecordingError
from servoscope.machines.kinds import kind_of_loop_file
from servoscope.models.loop import Loop

GOLDEN = Path(__file__).parents[1] / "golden" / "arm.npz"


def settings(**changes: object) -> ArmLoop:
    joints = {
        name: {"position": f"q{j + 1}", "torque": f"i{j + 1}", "gain": GAINS[j]}
        for j, name in enumerate(simulated_arm().names)
    }
    table = {"kind": "arm", "urdf": "six_joints.urdf", "sample_rate": 100.0, "joints": joints} | changes
    return ArmLoop.from_dict(table, "arm.toml")


def test_the_regressor_is_that_of_pinocchio() -> None:
    """`pin` 4.1.0: computeJointTorqueRegressor of the same URDF, gravity (0.3, -1, -9.80665)."""
    stored = np.load(GOLDEN)
    Y = torque_regressor(simulated_arm(), stored["q"], stored["v"], stored["a"], (0.3, -1.0, -9.80665))
    assert np.abs(Y.transpose(2, 0, 1) - stored["Y"]).max() < 1e-9


def test_power_is_the_change_of_energy() -> None:
    arm = simulated_arm()
    pi = arm.inertial.ravel()

    def kinetic(q: np.ndarray, v: np.ndarray) -> float:
        """Half of v' M v, M column by column from torques without gravity and speed."""
        M = [torque_regressor(arm, q[None], 0 * q[None], row[None], (0.0, 0.0, 0.0))[..., 0] @ pi for row in np.eye(6)]
        return 0.5 * float(v @ np.array(M) @ v)

    rng = np.random.default_rng(1)
    q, v, a = (rng.normal(size=6) for _ in range(3))
    h = 1e-5
    tau = torque_regressor(arm, q[None], v[None], a[None], (0.0, 0.0, 0.0))[..., 0] @ pi
    ahead, behind = (kinetic(q + s * v + s * s * a / 2, v + s * a) for s in (h, -h))
    assert float(tau @ v) == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)


def test_base_parameters_span_all_torques() -> None:
    model = ArmModel(simulated_arm(), settings())
    rng = np.random.default_rng(2)
    q, v, a = (rng.normal(size=(50, 6)) for _ in range(3))
    tau = np.einsum("jpn,p->jn", torque_regressor(model.arm, q, v, a), model.arm.inertial.ravel())
    assert np.allclose(model.inertial_torque(q, v, a, model.base.nominal), tau)
    assert 36 <= len(model.base.names) <= 42
    assert "shoulder.mx" in " ".join(model.base.names)


def urdf(**swaps: str) -> str:
    text = URDF.read_text(encoding="utf-8")
    for old, new in swaps.items():
        text = text.replace({"mass": '<mass value="0.6"/>', "kind": 'type="revolute"', "root": "<robot"}[old], new, 1)
    return text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (urdf(mass='<mass value="0"/>'), "joint 'flange_roll' has no inertia"),
        (urdf(kind='type="floating"'), "joints of type 'floating' are not supported"),
        (urdf(root='<robot xmlns:xacro="http://ros.org/wiki/xacro" a="${b}"'), "is xacro"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><robot/>', "declares entities"),
        ("<robot>", "is not XML"),
        ("<sdf/>", "is no URDF"),
        ("<robot/>", "0 links that no joint carries"),
        (
            '<robot><link name="a"/><link name="b"/>'
            + 2 * '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
            + "</robot>",
            "hangs on two joints",
        ),
        *(
            (urdf(mass=f'<mass value="{value}"/>'), rf"'{value}' is not 1 finite number")
            for value in ("nan", "inf", "1e999", "", "0,6")
        ),
        (URDF.read_text(encoding="utf-8").replace('lower="-3.1"', 'lower="nan"', 1), "'nan' is not 1 finite number"),
        (URDF.read_text(encoding="utf-8").replace('ixx="', 'ixx="-inf', 1), "is not 1 finite number"),
        (
            urdf(
                root='<robot><link name="a"/><link name="b"/>'
                + "".join(
                    f'<joint name="{one}{other}" type="fixed"><parent link="{one}"/><child link="{other}"/></joint>'
                    for one, other in ("ab", "ba")
                )
            ).replace(' name="six_joints">', "", 1),
            "link 'a' is carried in a circle",
        ),
    ],
)
def test_what_is_no_serial_arm_is_refused_in_one_line(text: str, words: str) -> None:
    with pytest.raises(LoopError, match=words) as error:
        parse_urdf(text, "arm.urdf")
    assert "\n" not in str(error.value) and str(error.value).startswith("arm.urdf: ")


def test_other_commands_refuse_an_arm(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text('kind = "arm"\n')
    assert kind_of_loop_file(path) == "arm"
    with pytest.raises(LoopError, match="describes a machine of kind 'arm', which is no loop"):
        Loop.load(path)


def test_units_and_joints_are_checked() -> None:
    arm, loop = simulated_arm(), settings()
    t = np.arange(1000) / 100.0
    log = {"t": t} | {f"{x}{j}": np.sin(t + j) for x in "qi" for j in range(1, 7)}
    assert read_arm_log(log, loop, arm).q.shape == (1000, 6)
    degrees = {name: 100.0 * x if name[0] == "q" else x for name, x in log.items()}
    with pytest.raises(RecordingError, match=r'limits of -3\.1 to 3\.1: set angle_unit = "deg"'):
        read_arm_log(degrees, loop, arm)
    turned = read_arm_log(degrees, settings(angle_unit="deg"), arm)
    assert np.abs(turned.q[:, 0] - np.radians(100.0) * np.sin(t + 1)).max() < 1e-6
    with pytest.raises(LoopError, match=r"\[joints\] and URDF differ in forearm_roll"):
        loop.model_copy(update={"joints": {k: x for k, x in loop.joints.items() if k != "forearm_roll"}}).kinematics(
            URDF.read_text(encoding="utf-8"), "six_joints.urdf"
        )


def test_motor_angles_become_joint_angles() -> None:
    gears = np.diag([50.0, -60.0, 40.0, 30.0, 30.0, 20.0])
    gears[5, 4] = 20.0
    arm, loop = simulated_arm(), settings(gears=gears.tolist())
    t = np.arange(1000) / 100.0
    q = np.sin(t[:, None] + np.arange(6))
    motors, currents = q @ gears.T, np.cos(t[:, None] * np.arange(1, 7))
    log = {"t": t} | {f"q{j + 1}": motors[:, j] for j in range(6)} | {f"i{j + 1}": currents[:, j] for j in range(6)}
    recording = read_arm_log(log, loop, arm)
    assert np.abs(recording.q - q).max() < 1e-6
    assert np.abs(recording.torque - (currents * GAINS) @ gears).max() < 1e-2
    assert len(ArmModel(arm, loop).coupled) == 1


ROBOTS = {  # what robots log: positions, torques or currents, and what else looks like them
    "UR": (
        "actual_q_{0}",
        "actual_current_{0}",
        ("target_q_{0}", "target_current_{0}", "actual_qd_{0}", "target_moment_{0}"),
    ),
    "KUKA": ("AIPos.A{1}", "MACur.A{1}", ("ASPos_target.A{1}",)),
    "Franka": ("q[{0}]", "tau_J[{0}]", ("dq[{0}]", "q_d[{0}]", "dtau_J[{0}]", "tau_J_d[{0}]", "dq_d[{0}]")),
    "ROS 2": ("position[{0}]", "effort[{0}]", ("velocity[{0}]",)),
    "by name": ("{2}/pos", "{2}/torque", ("{2}/vel",)),
}

OPTIONAL = {  # velocity, target, target torque
    "UR": ("actual_qd_{0}", "target_q_{0}", "target_moment_{0}"),
    "KUKA": (None, "ASPos_target.A{1}", None),
    "Franka": ("dq[{0}]", "q_d[{0}]", "tau_J_d[{0}]"),
    "ROS 2": ("velocity[{0}]", None, None),
    "by name": ("{2}/vel", None, None),
}


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_loop_file_is_proposed_from_what_robots_log(robot: str, tmp_path: Path) -> None:
    position, torque, others = ROBOTS[robot]
    t = np.arange(1000) / 100.0
    log = {"time": t}
    for j, joint in enumerate(simulated_arm().names):
        log |= {other.format(j, j + 1, joint): np.cos(t) for other in others}
        log[position.format(j, j + 1, joint)] = np.sin(t + j) * (100.0 if robot == "KUKA" else 1.0)
        log[torque.format(j, j + 1, joint)] = np.cos(t - j)
    pq.write_table(pa.table(log), tmp_path / "log.parquet")
    (tmp_path / "arm.urdf").write_bytes(URDF.read_bytes())
    loop, _ = propose_arm_loop(tmp_path / "log.parquet", tmp_path / "arm.urdf", "arm.urdf")
    assert loop.sample_rate == 100.0 and loop.angle_unit == ("deg" if robot == "KUKA" else "rad")
    assert [joint.position.strip("`") for joint in loop.joints.values()] == [
        position.format(j, j + 1, name) for j, name in enumerate(loop.joints)
    ]
    assert [joint.torque.strip("`") for joint in loop.joints.values()] == [
        torque.format(j, j + 1, name) for j, name in enumerate(loop.joints)
    ]
    elbow = loop.joints[simulated_arm().names[2]]
    optional = [column and column.strip("`") for column in (elbow.velocity, elbow.target, elbow.target_torque)]
    assert optional == [column and column.format(2, 3, "elbow") for column in OPTIONAL[robot]]
    written = tmp_path / "arm.toml"
    written.write_text(loop.to_toml({}), encoding="utf-8")
    assert ArmLoop.load(written)[0] == loop


def test_a_log_without_the_joints_of_the_urdf_is_refused(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_bytes(URDF.read_bytes())
    (tmp_path / "log.csv").write_text("t,q1,i1\n0,1,2\n0.01,1,2\n")
    with pytest.raises(
        RecordingError, match=r"no positions of 6 joints in it: name its columns by the joints \(base_yaw"
    ):
        propose_arm_loop(tmp_path / "log.csv", tmp_path / "arm.urdf", "arm.urdf")
