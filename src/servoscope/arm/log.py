"""Logs of an arm: positions and torques of all joints on one uniform time base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoscope.arm.settings import ArmLoop
from servoscope.arm.urdf import Kinematics
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import RecordingError
from servoscope.signals.readers.frames import Source
from servoscope.signals.readers.recording_file import read_channels
from servoscope.signals.resample import ResampleTarget, resample_rows
from servoscope.signals.time_axis import build_time_axis

MIN_DURATION_S = 5.0  # of the time that a log covers
MAX_DROPPED_SHARE = 0.5  # share of rows in which a joint may be missing
LIMIT_TOLERANCE = 0.1  # of a joint's range, and rad or m, by which a position may leave it
DEGREE = np.pi / 180.0


@dataclass(frozen=True, eq=False)
class ArmRecording:
    """A log of an arm on a uniform time base, in SI units, positions and torques of the joints."""

    name: str
    sample_rate: float  # [Hz]
    rows: int  # of the log itself
    t: FloatArray  # (N,)
    begins: tuple[int, ...]  # where stretches without gaps begin
    q: FloatArray  # (N, n) positions [rad or m]
    torque: FloatArray  # (N, n) [N m or N], in units of the log times the drive gain
    temperature: FloatArray  # (N, n) of the joints; 0 where it is not logged
    tool: FloatArray  # (N,) mass that the arm is known to carry [kg]; 0 where it is not logged
    # (N, n) where they are logged
    velocity: FloatArray | None = None  # [rad/s or m/s]
    target: FloatArray | None = None  # [rad or m]
    target_torque: FloatArray | None = None  # [N m or N]

    @property
    def duration_s(self) -> float:
        """From the first row to one sample after the last [s]."""
        return float(self.t[-1] - self.t[0]) + 1.0 / self.sample_rate


def read_arm_log(path: Source | Path, loop: ArmLoop, arm: Kinematics) -> ArmRecording:
    """Read a log; a row in which a signal of any joint is missing is a gap for all.

    Raises RecordingError if the log cannot be used.
    """
    joints = loop.columns_of(arm)
    name, stamps, channels = read_channels(path, loop.carrier.columns)
    axis = build_time_axis(stamps, None, None, name, regular=False)
    ordered = {key: axis.reorder(channel) for key, channel in channels.items()}
    whole = np.isfinite(np.array(list(ordered.values()))).all(0)
    whole[1:] &= np.diff(axis.t) > 0.0
    if whole.mean() < 1.0 - MAX_DROPPED_SHARE:
        share = {key: float(np.isfinite(channel).mean()) for key, channel in ordered.items()}
        worst = min(share, key=lambda key: share[key])
        raise RecordingError(
            f"{name}: {worst} is missing in {1.0 - share[worst]:.0%} of the rows, choose another column"
        )
    target = ResampleTarget(loop.sample_rate, loop.cutoff)
    rows = resample_rows(
        axis.t[whole], axis.run[whole], [channel[whole] for channel in ordered.values()], set(), target, name
    )
    resampled = dict(zip(ordered, rows.columns, strict=True))
    gaps = np.flatnonzero(np.diff(rows.t) > 1.5 / loop.sample_rate) + 1
    recording = ArmRecording(
        name,
        loop.sample_rate,
        stamps.size,
        rows.t - rows.t[0],
        (0, *gaps.tolist()),
        _joint_motion(loop, arm, resampled, "position"),
        _joint_torques(loop, arm, resampled),
        np.column_stack([resampled.get(f"{name}.temperature", np.zeros(rows.t.size)) for name in arm.names]),
        resampled.get("tool", np.zeros(rows.t.size)),
        _joint_motion(loop, arm, resampled, "velocity") if joints[0].velocity else None,
        _joint_motion(loop, arm, resampled, "target") if joints[0].target else None,
        _joint_columns(arm, resampled, "target_torque") if joints[0].target_torque else None,
    )
    if recording.duration_s < MIN_DURATION_S:
        raise RecordingError(
            f"{name}: {recording.duration_s:.2g} s are too short, at least {MIN_DURATION_S:g} s are needed"
        )
    _check_range(recording, loop, arm)
    return recording


def _joint_columns(arm: Kinematics, channels: Mapping[str, FloatArray], what: str) -> FloatArray:
    return np.column_stack([channels[f"{name}.{what}"] for name in arm.names])


def _joint_motion(loop: ArmLoop, arm: Kinematics, channels: Mapping[str, FloatArray], what: str) -> FloatArray:
    logged = _joint_columns(arm, channels, what)
    if loop.angle_unit == "deg":
        logged = logged * np.where(arm.prismatic, 1.0, DEGREE)
    offsets = np.array([joint.offset for joint in loop.columns_of(arm)]) * (what != "velocity")
    return np.asarray(np.linalg.solve(loop.gear_matrix(arm), logged.T).T + offsets)


def _joint_torques(loop: ArmLoop, arm: Kinematics, channels: Mapping[str, FloatArray]) -> FloatArray:
    gains = np.array([joint.gain for joint in loop.columns_of(arm)])
    return np.asarray((_joint_columns(arm, channels, "torque") * gains) @ loop.gear_matrix(arm))


def _check_range(recording: ArmRecording, loop: ArmLoop, arm: Kinematics) -> None:
    """Refuse positions far outside of the URDF's limits, which are degrees or motor angles as a rule."""
    for j, (low, high) in enumerate(arm.limits):
        slack = LIMIT_TOLERANCE * (high - low) + LIMIT_TOLERANCE
        least, most = float(recording.q[:, j].min()), float(recording.q[:, j].max())
        if least < low - slack or most > high + slack:
            hint = 'angle_unit = "deg", ' if loop.angle_unit == "rad" and not arm.prismatic[j] else ""
            raise RecordingError(
                f"{recording.name}: {arm.names[j]}: positions from {least:.4g} to {most:.4g} leave the URDF's limits of"
                f" {low:.4g} to {high:.4g}: set {hint}gears where they are of the motor, or offset"
            )
