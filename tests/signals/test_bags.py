"""Bags of ROS 1 and 2, written by the library that reads them and by others: commands and states are two topics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.core.arrays import FloatArray
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels, read

RATE = 100.0
BEGAN_NS = 1_700_000_000_000_000_000


def course(t: FloatArray) -> FloatArray:
    return np.sin(4.0 * t) + 0.3 * np.sin(9.0 * t)


def write_bag(path: Path, ros1: bool, joints: int, late_s: float) -> None:
    """Write states of joints, and commands a while later, as sensor_msgs/JointState and std_msgs/Float64."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    names = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
    kinds = {kind.rpartition("/")[2]: store.types[kind] for kind in names}
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.parent / "bag"
    writer: Any = Writer1(path) if ros1 else Writer2(folder, version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        states = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        command = writer.add_connection("/command", "std_msgs/msg/Float64", typestore=store)
        for k in range(600):
            at = BEGAN_NS + round(1e9 * k / RATE)
            stamp = kinds["Time"](sec=at // 10**9, nanosec=at % 10**9)
            header = {"stamp": stamp, "frame_id": "", **({"seq": k} if ros1 else {})}
            y = float(course(np.array(k / RATE))) * np.arange(1.0, joints + 1)
            names_of_joints = [f"j{n}" for n in range(joints)]
            state = kinds["JointState"](kinds["Header"](**header), names_of_joints, y, 0.0 * y, 2.0 * y)
            writer.write(states, at, serialize(state, "sensor_msgs/msg/JointState"))
            late = round(1e9 * late_s)
            data = float(course(np.array(k / RATE + late_s)))
            writer.write(command, at + late, serialize(kinds["Float64"](data=data), "std_msgs/msg/Float64"))
    if not ros1:
        next(folder.glob(f"*{path.suffix}")).rename(path)


@pytest.mark.parametrize("name", ["log.bag", "log.db3", "log.mcap"])
@pytest.mark.parametrize(("joints", "late_s"), [(1, 0.0), (6, 0.004)])
def test_a_bag_of_ros(name: str, joints: int, late_s: float, tmp_path: Path) -> None:
    path = tmp_path / name
    write_bag(path, name.endswith(".bag"), joints, late_s)
    channels = [channel.name for channel in list_channels(path)]
    assert "/joint_states.position[j0]" in channels and "/command.data" in channels
    last = f"`/joint_states.position[j{joints - 1}]`"
    columns = Columns(time="/joint_states.time", reference="`/command.data`", input="`/joint_states.effort[j0]`",
                      output=last, resample=True)  # fmt: skip
    recording = read(path, columns=columns)
    assert recording.samples >= 590 and recording.sample_rate == RATE
    t = (recording.t + (recording.began or 0.0)) - 1e-9 * BEGAN_NS
    np.testing.assert_allclose(recording.y, joints * course(t), atol=1e-4 * joints)
    np.testing.assert_allclose(recording.r, course(t), atol=1e-3)
