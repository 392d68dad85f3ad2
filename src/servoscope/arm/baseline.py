"""What a healthy arm looks like: its regression, how recordings scatter, and in which directions an arm changes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationError

from servoscope.arm.model import FRICTION, ArmModel
from servoscope.arm.regression import ANGLE_STEP, ArmSignals
from servoscope.arm.settings import ArmLoop
from servoscope.baseline.records import BaselineModel, BaselineSource, Matrix, Vector
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, LoopError
from servoscope.core.files import atomic_write
from servoscope.core.messages import MessageText

ARM_FORMAT = "servoscope-arm-baseline"
VERSION = 2
HEAD_LENGTH = 200  # characters, in which a baseline says what it is
UNKNOWN = "unknown"
# terms that stand for what depends on the motion before a joint turns round, and their standard deviation, as a share
MOTION_TERMS, MOTION_SHARE = (".lag", ".friction_curve"), 0.5
PAYLOAD = ("m", "mx", "my", "mz")
# standard deviations of a change, by kind: kg and kg m of a payload, rad of an encoder, shares of friction, of the
# joint's rms torque, of the drive gain, of the load on a joint
PAYLOAD_SIZES = (2.0, 0.5, 0.5, 0.5)
# of friction and payload a priori, per chance of another change: work alters these, repair and damage the others
SERVICE_ODDS = 10.0
FRICTION_SIZE, LOAD_SIZE, TORQUE_SIZE, GAIN_SIZE, ENCODER_SIZE, RIPPLE_SIZE = 0.3, 0.1, 0.3, 0.2, 0.05, 0.1


class ArmCause(NamedTuple):
    """A way in which an arm changes: columns of `ArmBaseline.deviations` that are free, and what it is called."""

    kind: str
    joint: str  # empty for what concerns the whole arm
    columns: tuple[int, ...]
    parameter: str  # of the first column

    @property
    def odds(self) -> float:
        """How likely it is a priori, relative to others."""
        return SERVICE_ODDS if self.kind in ("friction", "payload") else 1.0

    @property
    def name(self) -> str:
        """Kind and joint."""
        return f"{self.kind} of {self.joint}" if self.joint else self.kind


class ArmBaseline(BaselineModel):
    """What a healthy arm looks like; everything that its diagnosis needs.

    Parameters
    ----------
    loop, urdf
        The loop file and the text of the URDF.
    sources, notes
        The recordings that it was learned from, and what is to be said of them.
    names, theta, information
        The P coefficients of the regression: names, values, and their information matrix (P, P).
    temperature
        Mean temperature of each joint, to which its friction belongs.
    noise, inflation
        By joint: standard deviation of the torque that is left, and the factor by which its variance is larger for
        what lasts longer than a sample, both (n,).
    scale, between, drift
        Of each of the D directions of change: the standard deviation of a change; of healthy recordings around their
        mean; and of the second half of a recording against the first.
    torque
        Rms torque of each joint (n,).
    event_limits
        Largest torque, averaged over half a second, that healthy motion leaves, in units of `noise` (n,).
    limit
        Logarithm of the Bayes factor of a change from which it is reported.
    undetermined
        Friction that the motion does not determine, joint by joint.
    """

    loop_settings: dict[str, Any] = Field(alias="loop")
    urdf: str
    sources: tuple[BaselineSource, ...]
    names: tuple[str, ...]
    theta: Vector
    information: Matrix
    temperature: Vector
    noise: Vector
    inflation: Vector
    scale: Vector
    between: Vector
    drift: Vector
    torque: Vector
    event_limits: Vector
    limit: float
    undetermined: tuple[str, ...] = ()
    notes: tuple[MessageText, ...] = ()

    @cached_property
    def loop(self) -> ArmLoop:
        """The loop file."""
        return ArmLoop.from_dict(self.loop_settings, "baseline")

    @cached_property
    def model(self) -> ArmModel:
        """The arm."""
        return ArmModel(self.loop.kinematics(self.urdf, "baseline"), self.loop)

    @property
    def hash(self) -> str:
        """A digest of all fields: 16 hexadecimal digits."""
        return hashlib.sha256(self.model_dump_json(by_alias=True).encode()).hexdigest()[:16]

    def coefficient(self, name: str) -> tuple[float, float]:
        """Return a coefficient and its standard deviation."""
        index = self.names.index(name)
        return self.theta[index], float(self._std[index])

    @cached_property
    def _std(self) -> FloatArray:
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(np.array(self.information)))))

    def summary(self) -> dict[str, Any]:
        """Return friction and the share of unexplained torque of each joint, as plain values."""
        joints = {
            name: {
                "friction": [self.coefficient(f"{name}.{what}") for what in FRICTION[:2]],
                "unexplained": self.noise[j] / self.torque[j],
            }
            for j, name in enumerate(self.model.arm.names)
        }
        notes = [str(note) for note in self.notes]
        return {"joints": joints, "undetermined": list(self.undetermined), "notes": notes, "hash": self.hash}

    def design(self, signals: ArmSignals) -> FloatArray:
        """Return the columns of all coefficients, (n, P, M)."""
        return complete_columns(self.model, signals, np.array(self.theta), np.array(self.temperature))

    def deviations(self, signals: ArmSignals, design: FloatArray) -> FloatArray:
        """Return the columns of all directions of change, (n, D, M)."""
        return deviation_columns(self.model, signals, design, np.array(self.theta))

    @cached_property
    def random_effect(self) -> FloatArray:
        """The information (P + D, P + D) of what coefficients are off, and of how recordings differ."""
        size = len(self.theta)
        prior = np.diag(np.concatenate([np.zeros(size), np.array(self.between) ** -2.0]))
        prior[:size, :size] = loosen(np.array(self.information), self.names, np.array(self.theta))
        return prior

    @property
    def torque_std(self) -> FloatArray:
        """Standard deviation of what is left of each joint's torque, as it counts for what lasts (n,)."""
        return np.asarray(np.array(self.noise) * np.sqrt(self.inflation))

    @cached_property
    def causes(self) -> tuple[ArmCause, ...]:
        """The changes that are told apart."""
        return arm_causes(self.model)

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the Coulomb friction, viscous friction and offset of each joint, which diagnoses estimate."""
        units = {False: ("N m", "N m s", "N m"), True: ("N", "N s/m", "N")}
        return tuple(unit for is_slide in self.model.arm.prismatic for unit in units[bool(is_slide)])

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of the faults that may be found."""
        return tuple(dict.fromkeys(cause.name for cause in self.causes if cause.kind != UNKNOWN))

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind."""
        atomic_write(Path(path), self.to_text().encode())

    def to_text(self) -> str:
        """Return the baseline as JSON, as `save` writes it."""
        content = {"format": ARM_FORMAT, "version": VERSION, **self.model_dump(mode="json", by_alias=True)}
        return json.dumps(content, indent=1) + "\n"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return what `to_text` has written."""
        return cls.model_validate({k: v for k, v in json.loads(text).items() if k not in ("format", "version")})

    @classmethod
    def load(cls, path: str | Path) -> Self | None:
        """Read a baseline; None if the file is none of an arm.

        Raises BaselineError if it is damaged.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
            content = json.loads(text) if ARM_FORMAT in text[:HEAD_LENGTH] else {}
        except (OSError, ValueError, RecursionError):
            return None  # whoever reads other baselines says what is wrong
        if content.pop("format", None) != ARM_FORMAT:
            return None
        version = content.pop("version", None)
        if version == 1 and isinstance(loop := content.get("loop"), dict):
            loop["curve_speed"] = 0.0  # friction was a straight line then
        elif version != VERSION:
            raise BaselineError(
                f"{path}: baseline of version {version!r}, this program reads {VERSION}: learn it again"
            )
        try:
            baseline = cls.model_validate(content)
            _ = baseline.model
        except (ValidationError, LoopError) as error:
            raise BaselineError(f"{path}: damaged baseline, {str(error).splitlines()[0]}; learn it again") from None
        return baseline


def loosen(information: FloatArray, names: Sequence[str], theta: FloatArray) -> FloatArray:
    """Return the information of coefficients (P, P), of which those of lag and curve differ between motions."""
    size = np.array([MOTION_SHARE * abs(x) * name.endswith(MOTION_TERMS) for name, x in zip(names, theta, strict=True)])
    # (information^-1 + size^2)^-1
    return np.asarray(np.linalg.solve(np.eye(size.size) + information * size**2, information))


def coefficient_names(model: ArmModel) -> tuple[str, ...]:
    """Return the names of the columns of `complete_columns`."""
    arm, joints = model.arm, model.loop.columns_of(model.arm)
    load = [f"{name}.load_friction" for name in arm.names]
    warm = [
        f"{name}.{what}_per_degree"
        for name, joint in zip(arm.names, joints, strict=True)
        if joint.temperature is not None
        for what in FRICTION[:2]
    ]
    tool = [f"tool.{what}" for what in PAYLOAD] if model.loop.tool is not None else []
    return (*model.names, *load, *warm, *tool, *(f"{name}.lag" for name in arm.names if model.loop.curve_speed))


def complete_columns(model: ArmModel, signals: ArmSignals, theta: FloatArray, temperature: FloatArray) -> FloatArray:
    """Return columns with friction by load, by temperature, and of a known tool, (n, P, M).

    `theta`: coefficients, of which the base parameters give the load on the joints; `temperature`: to which friction
    belongs (n,).
    """
    n, still = model.arm.size, np.zeros_like(signals.q)
    motion = (signals.v, signals.a) if model.loop.curve_speed else (still, still)  # as in models that are published
    load = np.abs(model.inertial_torque(signals.q, *motion, theta[: len(model.base.names)]))
    friction = signals.columns.swapaxes(0, 1)[model.friction_columns]  # (n, 2) columns (n, M)
    further = [coulomb * load[j] for j, (_, coulomb) in enumerate(friction)]
    for j, joint in enumerate(model.loop.columns_of(model.arm)):
        if joint.temperature is not None:
            further += [column * (signals.temperature[:, j] - temperature[j]) for column in friction[j]]
    if model.loop.tool is not None:
        further += [signals.mass[:, index] * signals.tool for index in range(len(PAYLOAD))]
    columns = np.concatenate([signals.columns, np.stack(further, axis=1)], axis=1)
    if not model.loop.curve_speed:
        return columns
    expected = np.einsum("jpm,p->jm", columns, theta[: columns.shape[1]])
    lag = np.zeros((n, n, signals.t.size))
    lag[range(n), range(n)] = -np.gradient(expected, signals.t, axis=1)
    return np.concatenate([columns, lag], axis=1)


def deviation_columns(model: ArmModel, signals: ArmSignals, design: FloatArray, theta: FloatArray) -> FloatArray:
    """Return the columns of the directions of change, (n, D, M), in the order of `deviation_names`."""
    names, base = coefficient_names(model), theta[: len(model.base.names)]
    expected = np.einsum("jpm,p->jm", design, theta)
    columns = [signals.mass[:, index] for index in range(len(PAYLOAD))]
    for j, (name, joint) in enumerate(zip(model.arm.names, model.loop.columns_of(model.arm), strict=True)):
        columns += [design[:, names.index(f"{name}.{what}")] for what in FRICTION]
        angle, own = signals.q[:, j], np.zeros((4 + 2 * len(joint.ripple), *expected.shape))
        own[:4, j] = np.ones(angle.size), np.sin(angle), np.cos(angle), expected[j]
        for index, period in enumerate(joint.ripple):
            own[4 + 2 * index, j], own[5 + 2 * index, j] = np.sin(period * angle), np.cos(period * angle)
        step = np.zeros(model.arm.size)
        step[j] = ANGLE_STEP
        ahead, behind = (
            model.inertial_torque(signals.q + sign * step, signals.v, signals.a, base) for sign in (1.0, -1.0)
        )
        columns += [*own, (behind - ahead) / (2.0 * ANGLE_STEP)]
    return np.stack(columns, axis=1)


def deviation_scales(model: ArmModel, theta: FloatArray, torque: FloatArray) -> FloatArray:
    """Return the standard deviation of a change in each direction (D,); `torque`: rms of each joint (n,)."""
    scales = list(PAYLOAD_SIZES)
    for j, joint in enumerate(model.loop.columns_of(model.arm)):
        viscous, coulomb = np.abs(theta[model.friction_columns[j]])
        least = 0.01 * torque[j]  # of friction that is nearly none
        scales += [FRICTION_SIZE * max(viscous, least), FRICTION_SIZE * max(coulomb, least), LOAD_SIZE]
        scales += [TORQUE_SIZE * torque[j]] * 3 + [GAIN_SIZE]
        scales += [RIPPLE_SIZE * torque[j]] * (2 * len(joint.ripple)) + [ENCODER_SIZE]
    return np.array(scales)


def arm_causes(model: ArmModel) -> tuple[ArmCause, ...]:
    """Return the changes that are told apart, as columns of `deviation_columns`; the last is any of them at once."""
    causes, coulombs = [], []
    first = len(PAYLOAD)
    for name, joint in zip(model.arm.names, model.loop.columns_of(model.arm), strict=True):
        viscous, coulomb, load, offset, sine, cosine, gain = range(first, first + 7)
        coulombs.append(coulomb)
        causes += [
            ArmCause("friction", name, (coulomb,), "coulomb_friction"),
            ArmCause("friction", name, (viscous,), "viscous_friction"),
            ArmCause("friction", name, (coulomb, viscous, load), "coulomb_friction"),
            ArmCause("offset", name, (offset,), "offset"),
            ArmCause("counterbalance", name, (sine, cosine, offset), "counterbalance"),
            ArmCause("drive gain", name, (gain,), "gain"),
        ]
        for index, period in enumerate(joint.ripple):
            sines = first + 7 + 2 * index, first + 8 + 2 * index
            causes.append(ArmCause("gear ripple", name, sines, f"ripple {period:g}"))
        first += 8 + 2 * len(joint.ripple)
        causes.append(ArmCause("encoder offset", name, (first - 1,), "encoder"))
    # a payload loads the gears, which rub more then
    payload = tuple(range(len(PAYLOAD)))
    causes += [ArmCause("payload", "", payload, "m"), ArmCause("payload", "", (*payload, *coulombs), "m")]
    return (*causes, ArmCause(UNKNOWN, "", tuple(range(first)), UNKNOWN))
