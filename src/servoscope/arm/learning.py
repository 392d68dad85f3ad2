"""Learns from healthy logs of an arm: coefficients, what is left, how recordings scatter, and the limit of a change."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servoscope.arm.baseline import (
    ArmBaseline,
    arm_causes,
    coefficient_names,
    complete_columns,
    deviation_columns,
    deviation_scales,
    loosen,
)
from servoscope.arm.events import EVENT_MARGIN, MIN_EVENT_LIMIT, MIN_EVENT_SHARE, outside_torque
from servoscope.arm.evidence import (
    BETWEEN_SHARE,
    DRIFT_SHARE,
    ChangeTest,
    random_effect,
    second_half,
)
from servoscope.arm.log import ArmRecording
from servoscope.arm.model import ArmModel
from servoscope.arm.regression import (
    MIN_MOVING_S,
    ArmSignals,
    Information,
    block_information,
    filter_arm_log,
)
from servoscope.arm.settings import ArmLoop
from servoscope.arm.setup import nominal_gains
from servoscope.arm.urdf import Kinematics
from servoscope.baseline.records import BaselineSource
from servoscope.core.arrays import FloatArray, to_tuples
from servoscope.core.blas import with_one_blas_thread
from servoscope.core.errors import NotEnoughError, RecordingError
from servoscope.core.messages import Message, message

FIT_STEPS = 3  # of least squares, each weighted by what the one before left of each joint's torque
INFLATION_BLOCK_S = 2.0  # longer than the residual is correlated
MAX_FRICTION_STD = 0.3  # share of a friction torque from which the motion does not determine it
MAX_REVERSED = -3.0  # standard deviations below 0, from which friction says that a sign is wrong
MOUNTING_RATIO = 2.0  # by which another mounting has to explain more before the given one is doubted
MAX_COEFFICIENT = 1e3  # standard deviation of friction and offset a priori [N m, N m s]: nothing is known
MAX_LOAD_FRICTION = 0.05  # the same of friction by load [N m per N m], of which little is known where the load is small
NO_LOAD_FRICTION = 1e-6  # the same where the loop file leaves it out
MAX_GAIN_ERROR = 0.3  # share by which a gain may differ from that of the target torque
MAX_VELOCITY_ERROR = 0.1  # share by which a logged velocity may differ from the derivative of the position
MIN_RECORDINGS = 3  # from which recordings are judged by the others


class _Fit(NamedTuple):
    """Weighted least squares: coefficients (P,), noise (n,), and each recording's information and vector."""

    theta: FloatArray
    noise: FloatArray
    A: FloatArray  # (recordings, P, P)
    b: FloatArray  # (recordings, P)
    prior: FloatArray  # (P, P)


class _Scatter(NamedTuple):
    """How healthy recordings differ, in directions of change (D,)."""

    inflation: FloatArray  # of the noise's variance: samples of a joint hang together, (n,)
    information: list[Information]  # each recording's, of coefficients and of directions
    scale: FloatArray  # size of each direction
    between: FloatArray  # standard deviation between recordings
    drift: FloatArray  # within one


@with_one_blas_thread
def learn_arm(loop: ArmLoop, urdf: str, recordings: Sequence[ArmRecording]) -> ArmBaseline:
    """Learn from healthy recordings; `urdf`: the text of the URDF.

    Raises NotEnoughError if a joint hardly moves in them, RecordingError if a sign is reversed.
    """
    arm = loop.kinematics(urdf, loop.urdf)
    loop, recordings, notes = _choose_velocity(loop, arm, recordings)
    model = ArmModel(arm, loop)
    signals = [filter_arm_log(recording, model) for recording in recordings]
    _check_motion(model, signals)
    if recordings[0].target_torque is not None:
        ratios = zip(arm.names, nominal_gains(model, recordings[0], signals[0]), strict=True)
        off = [(joint, ratio) for joint, ratio in ratios if ratio and abs(ratio - 1.0) > MAX_GAIN_ERROR]
        notes += [message("arm.target_gain", joint=joint, ratio=ratio) for joint, ratio in off]
    temperature = np.mean([signal.temperature.mean(0) for signal in signals], axis=0)
    theta = _start(model)
    for _ in range(2):  # friction by load needs the load, which the first fit gives
        designs = [complete_columns(model, signal, theta, temperature) for signal in signals]
        fit = _fit(model, signals, designs)
        theta = fit.theta
    information = fit.A.sum(0) + fit.prior
    std = np.sqrt(np.diag(np.linalg.inv(information)))
    _check_signs(model, theta, std, recordings[0].name)
    torque = np.sqrt(np.mean([np.square(signal.tau).mean(1) for signal in signals], axis=0))
    residuals = _left_out_residuals(model, signals, designs, fit)
    scatter = _learn_scatter(model, signals, designs, residuals, fit, deviation_scales(model, theta, torque))
    typical = np.median(scatter.inflation)
    limits, odd = _judge_each(model, recordings, fit, scatter)
    events = np.max(
        [
            np.abs(outside_torque(signal, X, e, fit.noise, model, theta)).max(1) / fit.noise
            for signal, X, e in zip(signals, designs, residuals, strict=True)
        ],
        axis=0,
    )
    least_event = np.maximum(MIN_EVENT_LIMIT, MIN_EVENT_SHARE * torque / fit.noise)
    return ArmBaseline(
        loop=loop.model_dump(mode="json", exclude_defaults=True) | {"kind": "arm"},
        urdf=urdf,
        sources=tuple(BaselineSource(name=rec.name, samples=rec.rows, duration_s=rec.duration_s) for rec in recordings),
        names=coefficient_names(model),
        theta=to_tuples(theta),
        information=to_tuples(information / typical),
        temperature=to_tuples(temperature),
        noise=to_tuples(fit.noise),
        inflation=to_tuples(scatter.inflation),
        scale=to_tuples(scatter.scale),
        between=to_tuples(scatter.between),
        drift=to_tuples(scatter.drift),
        torque=to_tuples(torque),
        event_limits=to_tuples(np.maximum(EVENT_MARGIN * events, least_event)),
        limit=max(0.0, *limits),
        undetermined=tuple(_undetermined(model, theta, std * np.sqrt(typical))),
        notes=(*notes, *_mounting_notes(model, signals, designs, fit, recordings[0].name), *odd),
    )


def _choose_velocity(
    loop: ArmLoop, arm: Kinematics, recordings: Sequence[ArmRecording]
) -> tuple[ArmLoop, Sequence[ArmRecording], list[Message]]:
    """Return a loop and recordings whose velocities are the logged ones only if these are less noisy, and a note.

    Raises RecordingError if they are not the derivatives of the positions.
    """
    from scipy.signal import butter, sosfiltfilt

    low_pass, noise = butter(3, loop.cutoff, fs=loop.sample_rate, output="sos"), np.zeros(2)
    for recording in recordings:
        if recording.velocity is None:
            return loop, recordings, []
        ends = itertools.pairwise((*recording.begins, recording.t.size))
        rows = slice(*max(ends, key=lambda pair: pair[1] - pair[0]))
        both = np.array([np.gradient(recording.q[rows], 1.0 / loop.sample_rate, axis=0), recording.velocity[rows]])
        slow = sosfiltfilt(low_pass, both, axis=1)
        noise += np.square(both - slow).mean((1, 2))
        ratio = (slow[0] * slow[1]).sum(0) / np.maximum(np.square(slow[0]).sum(0), loop.rest_speed**2)
        moves = np.abs(slow[0]).max(0) > loop.rest_speed
        worst = int(np.argmax(np.abs(ratio - 1.0) * moves))
        if moves[worst] and abs(ratio[worst] - 1.0) > MAX_VELOCITY_ERROR:
            raise RecordingError(
                f"{recording.name}: velocity of {arm.names[worst]} is {ratio[worst]:.3g} times the derivative of its"
                " position: multiply its column accordingly, or leave velocity out"
            )
    if noise[1] < noise[0]:
        return loop, recordings, [message("arm.velocity_used", share=float(np.sqrt(noise[1] / noise[0])))]
    joints = {name: joint.model_copy(update={"velocity": None}) for name, joint in loop.joints.items()}
    plain = [replace(recording, velocity=None) for recording in recordings]
    return loop.model_copy(update={"joints": joints}), plain, [message("arm.velocity_left")]


def _left_out_residuals(
    model: ArmModel, signals: Sequence[ArmSignals], designs: Sequence[FloatArray], fit: _Fit
) -> list[FloatArray]:
    """Return what each recording leaves of the torques, by the coefficients of the others where there are several."""
    residuals = []
    for signal, X, A, b in zip(signals, designs, fit.A, fit.b, strict=True):
        theta = fit.theta
        if len(signals) >= MIN_RECORDINGS:
            theta = np.linalg.solve(fit.A.sum(0) + fit.prior - A, fit.b.sum(0) + fit.prior @ _start(model) - b)
        residuals.append(signal.tau - np.einsum("jpm,p->jm", X, theta))
    return residuals


def _learn_scatter(
    model: ArmModel,
    signals: Sequence[ArmSignals],
    designs: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    fit: _Fit,
    scale: FloatArray,
) -> _Scatter:
    columns = [
        np.concatenate([X, deviation_columns(model, signal, X, fit.theta)], axis=1)
        for signal, X in zip(signals, designs, strict=True)
    ]
    moves, left = slice(len(fit.theta), None), residuals
    for _ in range(2):  # by how recordings differ as a whole, they do not differ from block to block
        inflation = _inflation(signals, columns, left, fit.noise, len(fit.theta))
        weight = fit.noise * np.sqrt(inflation)
        whole = [
            block_information(*signal.weighted(X, e, weight))
            for signal, X, e in zip(signals, columns, residuals, strict=True)
        ]
        changes = [_change(information, moves) for information in whole]
        between = random_effect(changes, scale, BETWEEN_SHARE)
        own = [np.linalg.solve(A + np.diag(between**-2.0), g) for A, g in changes]
        left = [e - np.einsum("jdm,d->jm", X[:, moves], d) for X, e, d in zip(columns, residuals, own, strict=True)]
    halves = [second_half(information.part(moves), np.diag(between**-2.0)) for information in whole]
    return _Scatter(inflation, whole, scale, between, random_effect(halves, scale, DRIFT_SHARE))


def _change(information: Information, moves: slice) -> tuple[FloatArray, FloatArray]:
    """Return information and vector of a recording about the directions of change."""
    return information.A.sum(0)[moves, moves], information.g.sum(0)[moves]


def _judge_each(
    model: ArmModel, recordings: Sequence[ArmRecording], fit: _Fit, scatter: _Scatter
) -> tuple[list[float], list[Message]]:
    """Return what the evidence for a change reaches in healthy recordings, each judged by the others, and notes."""
    several = len(recordings) >= MIN_RECORDINGS
    false_alarms, typical = model.loop.false_alarms, np.median(scatter.inflation)
    moves, fixed = slice(len(fit.theta), None), slice(len(fit.theta))
    changes = [_change(information, moves) for information in scatter.information]
    limits, notes = list[float](), list[Message]()
    for i, information in enumerate(scatter.information):
        others = random_effect(changes[:i] + changes[i + 1 :], scatter.scale, BETWEEN_SHARE)
        prior = np.zeros((len(fit.theta) + scatter.scale.size,) * 2)
        known = (fit.A.sum(0) + fit.prior - several * fit.A[i]) / typical
        prior[fixed, fixed] = loosen(known, coefficient_names(model), fit.theta)
        prior[moves, moves] = np.diag((others if several else scatter.between) ** -2.0)
        test = ChangeTest(information, prior, arm_causes(model), scatter.scale, scatter.drift)
        if i == len(recordings) // 2:
            limits.append(test.healthy_limit(false_alarms))
        if several:
            evidence = test.weigh()
            limits.append(evidence.log_factor)
            if evidence.log_factor > -float(np.log(false_alarms)):
                cause = evidence.causes[0].cause
                joint = message("arm.of_joint", joint=cause.joint) if cause.joint else None
                notes.append(message("arm.odd_recording", name=recordings[i].name, kind=cause.kind, joint=joint))
    return limits, notes if several else [message("arm.few_recordings", least=MIN_RECORDINGS)]


def _start(model: ArmModel) -> FloatArray:
    """Return the coefficients (P,) before anything was measured: those of the URDF."""
    start = np.zeros(len(coefficient_names(model)))
    start[: len(model.base.names)] = model.base.nominal
    return start


def _fit(model: ArmModel, signals: Sequence[ArmSignals], designs: Sequence[FloatArray]) -> _Fit:
    start = _start(model)
    prior = np.zeros((start.size, start.size))
    size = model.base.size
    prior[range(size.size), range(size.size)] = size**-2.0
    further = np.arange(size.size, start.size)
    prior[further, further] = MAX_COEFFICIENT**-2.0
    load = len(model.names) + np.arange(model.arm.size)
    prior[load, load] = (MAX_LOAD_FRICTION if model.loop.load_friction else NO_LOAD_FRICTION) ** -2.0
    moving = np.concatenate([signal.moving for signal in signals], axis=1)
    tau = np.concatenate([signal.tau for signal in signals], axis=1)
    noise = np.sqrt((np.square(tau) * moving).sum(1) / moving.sum(1))
    for _ in range(FIT_STEPS):
        pieces = [
            block_information(*signal.weighted(X, signal.tau, noise), np.inf)
            for signal, X in zip(signals, designs, strict=True)
        ]
        A, b = np.array([piece.A[0] for piece in pieces]), np.array([piece.g[0] for piece in pieces])
        theta = np.linalg.solve(A.sum(0) + prior, b.sum(0) + prior @ start)
        left = tau - np.concatenate([np.einsum("jpm,p->jm", X, theta) for X in designs], axis=1)
        noise = np.sqrt((np.square(left) * moving).sum(1) / moving.sum(1))
    return _Fit(theta, noise, A, b, prior)


def _check_motion(model: ArmModel, signals: Sequence[ArmSignals]) -> None:
    period = float(np.median(np.diff(signals[0].t)))
    moved = np.sum([signal.moving.sum(1) for signal in signals], axis=0) * period
    for name, seconds in zip(model.arm.names, moved, strict=True):
        if seconds < MIN_MOVING_S:
            raise NotEnoughError(
                f"{name}: moves for {seconds:.1f} s in all recordings, at least {MIN_MOVING_S:g} s are needed:"
                " add a log in which it moves, or lower rest_speed"
            )


def _check_signs(model: ArmModel, theta: FloatArray, std: FloatArray, name: str) -> None:
    """Refuse friction that drives: the sign of a torque or of a gear is wrong."""
    friction = (theta / std)[model.friction_columns]
    worst = int(friction.sum(1).argmin())
    if friction[worst].sum() < 0.0 and friction[worst].min() < MAX_REVERSED:
        raise RecordingError(
            f"{name}: {model.arm.names[worst]}: its friction comes out negative, so position and torque have opposite"
            " signs: give it a negative gain, or correct its gear or its axis in the URDF"
        )


def _inflation(
    signals: Sequence[ArmSignals],
    columns: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    noise: FloatArray,
    first: int,
) -> FloatArray:
    """Return by how much the variance of sums over blocks exceeds that of independent samples, (n,).

    The mean eigenvalue of the block sums' covariance in the metric of the information, over the joint's directions.
    """
    inflation = np.ones(noise.size)
    for j in range(noise.size):
        A: FloatArray | float = 0.0
        G: FloatArray | float = 0.0
        for signal, X, e in zip(signals, columns, residuals, strict=True):
            t, Xw, ew = signal.weighted(X[:, first:], e, noise)
            blocks = block_information(t, Xw[j : j + 1], ew[j : j + 1], INFLATION_BLOCK_S)
            A, G = A + blocks.A.sum(0), G + blocks.g.T @ blocks.g
        values, vectors = np.linalg.eigh(np.asarray(A) / (size := np.sqrt(np.diag(A)) + 1e-300) / size[:, None])
        kept = values > 1e-6 * values[-1]
        basis = vectors[:, kept] / np.sqrt(values[kept]) / size[:, None]
        inflation[j] = max(1.0, float(np.trace(basis.T @ np.asarray(G) @ basis)) / kept.sum())
    return inflation


def _undetermined(model: ArmModel, theta: FloatArray, std: FloatArray) -> list[str]:
    """Return the friction terms that the motion leaves open; those of a joint together are what counts."""
    names = coefficient_names(model)
    return [names[i] for i in model.friction_columns.ravel() if std[i] > MAX_FRICTION_STD * abs(theta[i])]


def _mounting_notes(
    model: ArmModel, signals: Sequence[ArmSignals], designs: Sequence[FloatArray], fit: _Fit, name: str
) -> list[Message]:
    """Return a doubt about the mounting, where another direction of gravity explains the torques much better."""
    g = np.array(model.loop.gravity)
    size = float(np.linalg.norm(g))
    if size == 0.0:
        return []
    n, p = model.arm.size, len(model.base.names)
    left = {}
    for direction in np.concatenate([[g / size], np.eye(3), -np.eye(3)]):
        turned = ArmModel(model.arm, model.loop.model_copy(update={"gravity": tuple((size * direction).tolist())}))
        # only the links' nominal parameters: with all free, any mounting explains much
        total = np.zeros(n)
        for signal, X in zip(signals, designs, strict=True):
            rigid = turned.inertial_torque(signal.q, signal.v, signal.a, turned.base.nominal)
            left_over = signal.tau - rigid
            for j in range(n):
                used = X[j, p:][np.abs(X[j, p:]).max(1) > 0.0]
                scaled = np.column_stack([*used, rigid[j]])
                total[j] += float(np.square(left_over[j] - scaled @ np.linalg.lstsq(scaled, left_over[j])[0]).sum())
        left[tuple(np.round(direction, 3).tolist())] = float(np.sum(total / fit.noise**2))
    given = next(iter(left.values()))
    best = min(left, key=lambda direction: left[direction])
    if given <= MOUNTING_RATIO * left[best]:
        return []
    text = ", ".join(f"{x:.2f}" for x in size * np.array(best))
    return [message("arm.mounting", name=name, gravity=text, ratio=given / left[best])]
