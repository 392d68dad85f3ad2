"""A simulated arm of six joints under position control, whose loop reacts to what changes, and logs of it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from servoscope.arm.dynamics import torque_regressor
from servoscope.arm.settings import ArmLoop
from servoscope.arm.urdf import Kinematics, parse_urdf
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.core.files import atomic_write

URDF = files("servoscope.arm").joinpath("six_joints.urdf")
RATE = 200.0  # Hz, of the simulation
LOG_EVERY = 2  # samples
RAMP_S = 0.2  # over which a change comes
VISCOUS = (20.0, 22.0, 10.0, 4.0, 3.0, 2.5)  # N m s
COULOMB = (18.0, 16.0, 8.0, 4.0, 3.0, 2.0)  # N m
BY_LOAD = 0.05  # Coulomb friction by load [N m per N m]
SIGN_SPEED = 0.05  # rad/s
INERTIA = (9.0, 9.0, 4.0, 2.0, 1.5, 1.0)  # kg m^2, about which the servos are tuned, above that of the joints
ROTOR = (2.0, 2.0, 0.8, 0.25, 0.15, 0.08)  # kg m^2 behind the gears
BANDWIDTH = 2.0 * np.pi * 8.0  # of the servos [rad/s]
DAMPING = 0.9
GAINS = (12.0, 12.0, 10.0, 9.0, 9.0, 8.0)  # N m/A
AMPLITUDE = (1.2, 0.5, 0.7, 1.2, 1.0, 1.5)  # rad
CENTRE = (0.0, 0.4, -0.3, 0.0, 0.5, 0.0)  # rad
HARMONICS = 5
MAX_PERIOD_S = 10.0
DAY_SPREAD, TORQUE_NOISE, ANGLE_NOISE = 0.03, 0.02, 2e-5  # of friction; of the rms current; rad
EXAMPLE_S = 40.0  # of the logs of `write_example`
ITERATIONS = 16  # of the motion: twice as many move no position by more than 6e-6 rad
KINDS = ("payload", "friction", "drive gain", "offset", "encoder offset")


@dataclass(frozen=True)
class ArmChange:
    """What changes in a simulated arm: a kind of `KINDS`, its joint from 1, its size, and when [s].

    Sizes: kg; ratios of Coulomb friction and of the drive gain; N m; rad.
    """

    kind: str
    size: float
    joint: int = 6
    onset_s: float = 0.0


def simulated_arm() -> Kinematics:
    """Return the arm."""
    return parse_urdf(URDF.read_text(encoding="utf-8"), "six_joints.urdf")


def simulated_arm_loop() -> ArmLoop:
    """Return the loop whose logs `simulate_arm` returns."""
    joints = {
        name: {"position": f"q{j + 1}", "torque": f"i{j + 1}", "gain": GAINS[j]}
        for j, name in enumerate(simulated_arm().names)
    }
    rate = RATE / LOG_EVERY
    table = {"kind": "arm", "urdf": URDF.name, "sample_rate": rate, "sign_speed": SIGN_SPEED, "joints": joints}
    return ArmLoop.from_dict(table, "arm.toml")


def simulate_arm(seed: int, duration_s: float = 60.0, change: ArmChange | None = None) -> dict[str, FloatArray]:
    """Return a log of the arm on a motion of its own: t, q1 to q6 [rad], i1 to i6 [A], at 100 Hz.

    Each seed is a day with a motion and friction of its own. The motion solves the closed loop's equation
    M e'' + d e' + k e = torque needed - torque foreseen by iteration over the whole recording (waveform relaxation).
    """
    from scipy.signal import bilinear, lfilter

    if change is not None and (change.kind not in KINDS or not 1 <= change.joint <= len(VISCOUS)):
        raise SimulationError(f"{change.kind} of joint {change.joint}: kinds are {', '.join(KINDS)}, joints 1 to 6")
    rng, arm, n = np.random.default_rng(seed), simulated_arm(), len(VISCOUS)
    t = np.arange(round(duration_s * RATE)) / RATE
    reference = _motion(rng, t)
    friction = 1.0 + DAY_SPREAD * rng.normal(size=n)
    late = np.clip((t - change.onset_s) / RAMP_S, 0.0, 1.0) if change is not None else np.zeros(t.size)
    size = change.size if change is not None else 0.0
    of = {kind: np.zeros((t.size, n)) for kind in KINDS}
    if change is not None:
        neutral = 1.0 if change.kind in ("friction", "drive gain") else 0.0
        of[change.kind][:, change.joint - 1] = (size - neutral) * late
    coulomb = np.array(COULOMB) * friction * (1.0 + of["friction"])
    M, offset = np.array(INERTIA), of["encoder offset"]
    servo = [1.0, 2.0 * DAMPING * BANDWIDTH, BANDWIDTH**2]

    def needed(q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        Y = torque_regressor(arm, q, v, a)
        tau = np.einsum("jpn,p->nj", Y, arm.inertial.ravel())
        if change is not None and change.kind == "payload":
            tau += ((Y[:, 10 * n - 10] + 0.1 * Y[:, 10 * n - 9]) * (size * late)).T  # its centre is 0.1 m ahead
        return np.asarray(tau + np.array(ROTOR) * a)

    # on the way that is meant: the loop's error does not change a load
    load = np.abs(needed(*reference))

    def resist(v: FloatArray) -> FloatArray:
        return (coulomb + BY_LOAD * load) * np.tanh(v / SIGN_SPEED) + np.array(VISCOUS) * friction * v + of["offset"]

    q, v, a = reference
    foreseen = np.einsum("jpn,p->nj", torque_regressor(arm, *reference), arm.inertial.ravel())
    for _ in range(ITERATIONS):
        tau = needed(q, v, a) + resist(v)
        # with the servo's own inertia on the other side: M e'' + d e' + k e = this, with e = reference - q
        left = tau - foreseen - M * (a - reference[2])
        e, de, dde = (
            lfilter(*bilinear(power, servo, RATE), left / M, axis=0) for power in ([1.0], [1.0, 0.0], [1.0, 0.0, 0.0])
        )
        q, v, a = reference[0] - e - offset, reference[1] - de, reference[2] - dde
    tau = needed(q, v, a) + resist(v)
    current = tau / (np.array(GAINS) * (1.0 + of["drive gain"]))
    current += TORQUE_NOISE * current.std(0) * rng.normal(size=current.shape)
    measured = q + offset + ANGLE_NOISE * rng.normal(size=q.shape)
    log = {"t": t[::LOG_EVERY]}
    for name, signal in (("q", measured), ("i", current)):
        log |= {f"{name}{j + 1}": signal[::LOG_EVERY, j] for j in range(n)}
    return log


def _motion(rng: np.random.Generator, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, velocity and acceleration of a random sum of sines, (N, n) each."""
    w = 2.0 * np.pi / MAX_PERIOD_S * np.arange(1, HARMONICS + 1)
    size = rng.normal(size=(len(AMPLITUDE), HARMONICS)) / np.arange(1, HARMONICS + 1)
    size *= (np.array(AMPLITUDE) / np.abs(size).sum(1))[:, None]
    angle = t[:, None, None] * w + rng.uniform(0.0, 2.0 * np.pi, size.shape)
    q, v, a = ((size * part).sum(2) for part in (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle)))
    return q + np.array(CENTRE), v, a


def write_example(folder: str | Path) -> None:
    """Write a loop file, its URDF, five healthy logs, two in which friction or payload changes, and one of 5 kg.

    Raises OutputError if one of them cannot be written.
    """
    folder = Path(folder)
    atomic_write(folder / "six_joints.urdf", URDF.read_bytes())
    lines = [
        'kind = "arm"',
        'name = "six joints"',
        'urdf = "six_joints.urdf"',
        "sample_rate = 100.0",
        f"sign_speed = {SIGN_SPEED}",
    ]
    for j, name in enumerate(simulated_arm().names):
        columns = [f'position = "q{j + 1}"', f'torque = "i{j + 1}"', f"gain = {GAINS[j]}"]
        lines += ["", f"[joints.{name}]", *columns]
    atomic_write(folder / "arm.toml", ("\n".join(lines) + "\n").encode())
    logs: dict[str, ArmChange | None] = {f"day{day + 1}": None for day in range(5)}
    logs |= {"tuesday": ArmChange("friction", 1.4, 3, 20.0), "pallet": ArmChange("payload", 2.0, 6, 20.0)}
    logs["load"] = ArmChange("payload", 5.0)
    for seed, (name, change) in enumerate(logs.items()):
        log = simulate_arm(seed, EXAMPLE_S, change)
        rows = np.column_stack(list(log.values()))
        text = ",".join(log) + "\n" + "\n".join(",".join(f"{x:.7g}" for x in row) for row in rows) + "\n"
        atomic_write(folder / f"{name}.csv", text.encode())
