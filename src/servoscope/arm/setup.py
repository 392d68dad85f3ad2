"""Begins an arm: a loop file proposed from a log and a URDF, and drive gains from a load of known mass."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servoscope.arm.baseline import PAYLOAD, ArmBaseline
from servoscope.arm.log import ArmRecording, read_arm_log
from servoscope.arm.model import ArmModel
from servoscope.arm.regression import ArmSignals, block_information, filter_arm_log
from servoscope.arm.settings import DEFAULT_CUTOFF, ArmLoop
from servoscope.arm.urdf import Kinematics, parse_urdf
from servoscope.core.arrays import FloatArray
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import LoopError, NotEnoughError, RecordingError
from servoscope.core.messages import Message, message
from servoscope.core.settings import read_toml_text
from servoscope.fit.search import Experiment, fit
from servoscope.models.loop import Columns
from servoscope.signals.readers import list_channels
from servoscope.signals.readers.guess_columns import guess_mapping, quoted_channel
from servoscope.signals.readers.recording_file import read_channels

# of the words in a column's name, without its joint
ASKED_FOR = re.compile(r"target|des(?![a-z])|cmd|command|goal|soll|(?<![a-z])ref|_d(?![a-z])")
VELOCITY = re.compile(r"vel|speed|(?<![a-z])(?:dq|qd)(?![a-z])")
ERROR = re.compile(r"error")
POSITION = re.compile(r"pos|angle|winkel|(?<![a-z])q(?![a-z])")
TORQUE = re.compile(r"effort|torque|moment|(?<![a-z])tau")
CURRENT = re.compile(r"cur|amps|strom|(?<![a-z])i(?![a-z])")
MAX_RADIANS = 2.2 * np.pi  # that an arm's joint turns, beyond which positions are degrees
MIN_WEIGHT_SHARE = 0.9  # of the torque less friction and inertia, that the links' weight explains to give a gain
GAIN_SPREAD = 0.5  # standard deviation of a drive gain a priori, as a share of that of the data sheet
MAX_GAIN_STD = 0.1  # of a drive gain that a load determines


def propose_arm_loop(log: Path, urdf: Path, name: str) -> tuple[ArmLoop, dict[str, Message]]:
    """Return a loop file for a log, and the reason for each of its keys; `name`: of the URDF in the loop file.

    Raises LoopError if the URDF cannot be used, RecordingError if the log lacks positions or torques of its joints.
    """
    text = read_toml_text(urdf, "URDF", LoopError)
    arm = parse_urdf(text, str(urdf))
    channels = {channel.name: channel for channel in list_channels(log)}
    columns = _columns_by_joint(list(channels), arm)
    positions = _choose(columns, POSITION)
    torques = _choose(columns, TORQUE) or _choose(columns, CURRENT)
    if positions is None or torques is None:
        raise RecordingError(
            f"{log}: no {'positions' if positions is None else 'currents or torques'} of {arm.size} joints in it: name"
            f" its columns by the joints ({', '.join(arm.names)}) or number them, and make joints fixed in {urdf} that"
            f" no log has; the file has {', '.join(list(channels)[:12])}"
        )
    optional = {
        "velocity": _choose(columns, VELOCITY),
        "target": _choose(columns, ASKED_FOR, POSITION, (VELOCITY, ERROR)),
        "target_torque": _choose(columns, ASKED_FOR, TORQUE, (VELOCITY, ERROR)),
    }
    guessed = guess_mapping(list(channels))
    time = {"time": guessed["time"] or "t", "time_unit": guessed["time_unit"]}
    joints: dict[str, dict[str, Any]] = {
        joint: {"position": quoted_channel(q), "torque": quoted_channel(i)}
        for joint, q, i in zip(arm.names, positions, torques, strict=True)
    }
    for key, group in optional.items():
        for joint, column in zip(arm.names, group or (), strict=bool(group)):
            joints[joint][key] = quoted_channel(column)
    reach = max(max(abs(channels[q].min), abs(channels[q].max)) for q in positions)
    stamps = read_channels(log, Columns(**time, reference=positions[0], input=torques[0], output=positions[0]))[1]
    rate = float(f"{1.0 / np.median(np.diff(stamps)):.3g}")
    table = {"kind": "arm", "name": urdf.stem, "urdf": name, "sample_rate": rate, **time, "joints": joints}
    table |= {"angle_unit": "deg"} if reach > MAX_RADIANS else {}
    table |= {"cutoff": rate / 10.0} if rate < 10.0 * DEFAULT_CUTOFF else {}
    loop = ArmLoop.from_dict(table, str(log))
    why = {
        "sample_rate": message("init.rate", samples=stamps.size),
        "angle_unit": message("init.arm_degrees", reach=float(reach)),
        f"{arm.names[0]}.position": message("init.arm_order"),
    }
    recording = read_arm_log(log, loop, arm)  # refuses positions beyond the limits of the URDF
    if torques == _choose(columns, TORQUE):
        return loop, why
    reason = "init.arm_gain" if recording.target_torque is None else "init.arm_target_gain"
    signals = filter_arm_log(recording, model := ArmModel(arm, loop))
    for joint, gain in zip(arm.names, nominal_gains(model, recording, signals), strict=True):
        joints[joint]["gain"] = float(f"{gain or 1.0:.3g}")
        why[f"{joint}.gain"] = message(reason if gain else "init.arm_no_gain")
    return ArmLoop.from_dict(table, str(log)), why


def _columns_by_joint(names: Sequence[str], arm: Kinematics) -> dict[str, tuple[str, ...]]:
    """Return columns in the order of the joints, by what their names have in common; joints by name, or by number."""
    groups: dict[str, dict[int, str]] = defaultdict(dict)
    for name in names:
        joint = max((joint for joint in arm.names if joint in name), key=len, default=None)
        number = None if joint else re.search(r"\d+(?=\D*$)", name)
        if joint:
            groups[name.replace(joint, "", 1)][arm.names.index(joint)] = name
        elif number:
            groups[f"{name[: number.start()]} {name[number.end() :]}"][int(number[0])] = name
    ordered = {what: tuple(group[index] for index in sorted(group)) for what, group in groups.items()}
    return {what: group for what, group in ordered.items() if len(group) == arm.size}


def _choose(
    columns: dict[str, tuple[str, ...]],
    words: re.Pattern[str],
    second: re.Pattern[str] | None = None,
    unlike: Sequence[re.Pattern[str]] | None = None,
) -> tuple[str, ...] | None:
    """Return the columns whose common name has one of the words, of `second` too, and none of `unlike`; None without.

    `unlike`: without it, of what is not measured, and of velocities but for them.
    """
    unlike = unlike or [pattern for pattern in (ASKED_FOR, VELOCITY, ERROR) if pattern is not words]
    for what, group in columns.items():
        if all(p.search(what.lower()) for p in (words, second or words)) and not any(
            p.search(what.lower()) for p in unlike
        ):
            return group
    return None


@with_one_blas_thread
def nominal_gains(model: ArmModel, recording: ArmRecording, signals: ArmSignals) -> list[float | None]:
    """Return the gains with which torques agree with target torques, or else with the weights of the URDF.

    As factors of the loop file's gains; None where they show little.
    """
    still = np.zeros_like(signals.q)
    weight = model.inertial_torque(signals.q, still, still, model.base.nominal)
    if recording.target_torque is not None:
        weight = np.array([np.interp(signals.t, recording.t, own) for own in recording.target_torque.T])
    gains: list[float | None] = []
    for j in range(model.arm.size):
        v, used = signals.v[:, j], signals.moving[j]
        others = np.column_stack([v, np.tanh(v / model.loop.sign_speed), np.ones(v.size)])[used]
        if recording.target_torque is None:  # which the weight does not hold
            others = np.column_stack([others, signals.a[used, j]])
        both = np.column_stack([weight[j], signals.tau[j]])[used]
        x, i = (both - others @ np.linalg.lstsq(others, both)[0]).T if used.any() else np.zeros((2, 1))
        explained = float(x @ i) ** 2 / max(float(x @ x) * float(i @ i), 1e-300)
        gains.append(float(x @ x / (x @ i)) if explained > MIN_WEIGHT_SHARE else None)
    return gains


class JointGain(NamedTuple):
    """The drive gain of a joint from a known load [N m per unit that is logged]; `std`: as a share of it."""

    joint: str
    gain: float
    std: float

    @property
    def determined(self) -> bool:
        """Whether the load determines the gain."""
        return self.std <= MAX_GAIN_STD


@with_one_blas_thread
def calibrate_load(baseline: ArmBaseline, recording: ArmRecording, mass: float) -> list[JointGain]:
    """Return the drive gains with which a load has its known mass [kg], joint by joint.

    `recording`: with the load, which the healthy recordings of `baseline` were without. Joint j shows 1/c_j times the
    torque of the load, c_j the ratio of its true gain to that of the loop file; the c_j and the load's centre of mass
    are found together. Raises LoopError for coupled joints, NotEnoughError if the arm hardly moves.
    """
    model = baseline.model
    if len(model.coupled):
        raise LoopError(
            "gears: a load does not separate the gains of motors that turn several joints: give data sheets"
        )
    signals, n = filter_arm_log(recording, model), model.arm.size
    design = baseline.design(signals)
    residual = signals.tau - np.einsum("jpm,p->jm", design, np.array(baseline.theta))
    own = np.zeros((n, n, len(PAYLOAD), signals.t.size))  # what the load adds to each joint alone
    own[range(n), range(n)] = signals.mass
    columns = [design, baseline.deviations(signals, design), own.reshape(n, -1, signals.t.size)]
    if not signals.moving.any():
        raise NotEnoughError(f"{recording.name}: the arm does not move, give a log of moves with the load")
    rows = signals.weighted(np.concatenate(columns, axis=1), residual, baseline.torque_std)
    whole = block_information(*rows, np.inf)
    first, prior = n * len(PAYLOAD), baseline.random_effect
    A, g, others = whole.A[0], whole.g[0], whole.A[0][:-first, :-first] + prior
    gain = np.linalg.solve(others, A[:-first, -first:])
    known = A[-first:, -first:] - A[-first:, :-first] @ gain
    values, vectors = np.linalg.eigh(known)
    kept = values > 1e-9 * values[-1]
    root = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    target = root @ np.linalg.pinv(known, hermitian=True) @ (g[-first:] - gain.T @ g[:-first])

    def misfit(x: FloatArray) -> FloatArray:
        return np.asarray(root @ np.outer(1.0 + x[:n], np.concatenate([[mass], x[n:]])).ravel() - target)

    unknowns = n + len(PAYLOAD) - 1  # a joint's ratio of gains less 1, and the load's centre of mass times its mass
    fitted = fit(Experiment(misfit, np.where(np.arange(unknowns) < n, GAIN_SPREAD, np.inf)), np.zeros(unknowns))
    ratio, std = 1.0 + fitted.x, np.sqrt(np.diag(fitted.covariance))
    return [
        JointGain(joint, baseline.loop.joints[joint].gain / float(ratio[j]), float(std[j] / abs(ratio[j])))
        for j, joint in enumerate(model.arm.names)
    ]
