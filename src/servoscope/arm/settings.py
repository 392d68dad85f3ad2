"""The loop file of an arm: its URDF, the columns of its joints, and how it is monitored."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from servoscope.arm.dynamics import STANDARD_GRAVITY
from servoscope.arm.urdf import Kinematics, parse_urdf
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError
from servoscope.core.settings import (
    NOT_ZERO,
    Finite,
    NonEmptyStr,
    NonNegative,
    Positive,
    Settings,
    parse_toml,
    read_toml_text,
)
from servoscope.core.settings_errors import describe_error
from servoscope.models.loop import Loop

OF_ALL_JOINTS = ("velocity", "target", "target_torque")  # columns that all joints have, or none
DEFAULT_CUTOFF = 5.0  # Hz; the motion of an arm lies below, the ripple of its gears above


class JointColumns(Settings):
    """Where the signals of one joint stand in a log: columns, or linear combinations of columns."""

    position: NonEmptyStr  # angle or travel of the joint, or of its motor where `gears` are given
    torque: NonEmptyStr  # motor current, or torque
    gain: Annotated[Finite, NOT_ZERO] = 1.0  # drive gain [N m per unit of `torque`]
    offset: Finite = 0.0  # added to the position, for a zero other than the URDF's [rad or m]
    temperature: NonEmptyStr | None = None  # of the joint, on which its friction may depend
    velocity: NonEmptyStr | None = None  # as the position, used where it is less noisy than its derivative
    target: NonEmptyStr | None = None  # position that the controller asks for
    target_torque: NonEmptyStr | None = None  # that the controller asks for, without friction [N m or N]
    # periods of the torque ripple per turn of the joint, for example the teeth of a gear
    ripple: tuple[Positive, ...] = ()


class ArmLoop(Settings):
    """One arm: its joints, their columns, and how it is monitored."""

    kind: Literal["arm"]
    name: NonEmptyStr = "arm"  # what the arm is called in reports
    urdf: NonEmptyStr  # URDF of the arm, relative to the loop file
    sample_rate: Positive  # rate that logs are resampled to [Hz]
    time: NonEmptyStr = "t"  # column of the time stamps
    time_unit: Literal["s", "ms", "us", "ns", "min"] = "s"  # unit of a numeric time column
    angle_unit: Literal["rad", "deg"] = "rad"  # unit of the positions of turning joints
    gravity: tuple[Finite, Finite, Finite] = STANDARD_GRAVITY  # in the frame of the base [m/s^2], by the mounting
    # rows of motor angle per joint angle, where columns are those of the motors; coupled wrists have several entries
    gears: tuple[tuple[Finite, ...], ...] | None = None
    cutoff: Positive = DEFAULT_CUTOFF  # of the filters on motion and torque [Hz]
    rest_speed: Positive = 0.03  # speed below which a joint rests, and its friction is not known [rad/s or m/s]
    sign_speed: Positive = 0.01  # v0 of tanh(v/v0), which stands for the sign in Coulomb friction [rad/s or m/s]
    # v1 of tanh(v/v1), by which friction departs from a straight line over the speed [rad/s or m/s]; 0: it does not,
    # and torques do not lag behind positions, as in models that are published
    curve_speed: NonNegative = 0.5
    load_friction: bool = True  # whether Coulomb friction grows with the load on a joint
    # where drive gains come from: data sheets, or a known load, without which masses are relative to the gains
    gains: Literal["data sheet", "load"] = "data sheet"
    payload: Literal["change", "fault"] = "change"  # what a change of the payload is
    tool: NonEmptyStr | None = None  # column of the mass that the arm is known to carry [kg]
    # share of healthy recordings that may be called changed
    false_alarms: Annotated[float, Field(gt=0.0, le=0.5)] = 0.005
    joints: Annotated[dict[NonEmptyStr, JointColumns], Field(min_length=1)]  # by their names in the URDF

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.cutoff >= self.sample_rate / 5.0:
            raise ValueError(f"cutoff: {self.cutoff:g} Hz is not below a fifth of sample_rate, lower it")
        n = len(self.joints)
        for key in OF_ALL_JOINTS:
            if 0 < [getattr(joint, key) for joint in self.joints.values()].count(None) < n:
                raise ValueError(f"joints: {key} must be given of all joints, or of none")
        if self.gears is not None:
            if len(self.gears) != n or any(len(row) != n for row in self.gears):
                raise ValueError(f"gears: must be {n} rows of {n} numbers, a row per motor and a number per joint")
            if np.linalg.matrix_rank(np.array(self.gears)) < n:
                raise ValueError("gears: cannot be inverted, check its rows")
        return self

    @classmethod
    def load(cls, path: str | Path) -> tuple[Self, str]:
        """Return the settings of a loop file, and the text of the URDF that it names.

        Raises LoopError if one of them cannot be read or is wrong.
        """
        path = Path(path)
        settings = cls.from_dict(parse_toml(read_toml_text(path, "loop file", LoopError), path, LoopError), str(path))
        urdf = path.parent / settings.urdf
        text = read_toml_text(urdf, "URDF", LoopError)
        settings.kinematics(text, str(urdf))
        return settings, text

    @classmethod
    def from_dict(cls, mapping: Mapping[str, Any], source: str) -> Self:
        """Return the settings of a table; raises LoopError, which calls it `source`, if one is wrong."""
        try:
            return cls.model_validate(dict(mapping))
        except ValidationError as error:
            raise LoopError(f"{source}: {describe_error(error, cls)}") from None

    def to_toml(self, reasons: Mapping[str, str]) -> str:
        """Return the loop file; `reasons`: comments by key, those of a joint by ``joint.key``."""
        table = self.model_dump(mode="json", exclude_unset=True)
        sections = [("", {key: value for key, value in table.items() if key != "joints"}), *table["joints"].items()]
        lines = []
        for joint, values in sections:
            lines += ["", f"[joints.{json.dumps(joint)}]"] if joint else []
            for key, value in values.items():
                line = f"{key} = {json.dumps(value, ensure_ascii=False)}"
                why = reasons.get(f"{joint}.{key}".lstrip("."))
                lines.append(f"{line:<40}  # {why}" if why else line)
        return "\n".join(lines) + "\n"

    def kinematics(self, urdf: str, source: str) -> Kinematics:
        """Return the arm of a URDF's text; raises LoopError if its moving joints are not those of the file."""
        arm = parse_urdf(urdf, source)
        if set(arm.names) != set(self.joints):
            missing = sorted(set(arm.names) ^ set(self.joints))
            raise LoopError(
                f"{source}: [joints] and URDF differ in {', '.join(missing)}: name each moving joint, which are"
                f" {', '.join(arm.names)}; make those fixed that no log has"
            )
        return arm

    @property
    def channels(self) -> dict[str, str]:
        """The columns of all signals, by ``JOINT.position``, ``JOINT.torque`` and so on, and ``tool``."""
        tables = ((f"{name}.{key}", value) for name, joint in self.joints.items() for key, value in joint)
        return {name: column for name, column in (*tables, ("tool", self.tool)) if isinstance(column, str)}

    @property
    def carrier(self) -> Loop:
        """The first joint as a loop, whose log or messages carry the signals of all joints as covariates."""
        first = next(iter(self.joints.values()))
        columns = {"time": self.time, "time_unit": self.time_unit, "covariates": self.channels}
        columns |= {"reference": first.position, "input": first.torque, "output": first.position}
        plant = {"kind": "axis"}
        return Loop.from_dict({"name": self.name, "sample_rate": self.sample_rate, "columns": columns, "plant": plant})

    def of_channels(self) -> Self:
        """Return it for columns that are called as `channels` says, and time in seconds in a column ``t``."""
        joints = {
            name: joint.model_copy(update={key: f"{name}.{key}" for key, value in joint if isinstance(value, str)})
            for name, joint in self.joints.items()
        }
        tool = None if self.tool is None else "tool"
        return self.model_copy(update={"joints": joints, "tool": tool, "time": "t", "time_unit": "s"})

    def columns_of(self, arm: Kinematics) -> tuple[JointColumns, ...]:
        """Return the columns of the joints in the order of the arm."""
        return tuple(self.joints[name] for name in arm.names)

    def gear_matrix(self, arm: Kinematics) -> FloatArray:
        """Return G of motor angles = G q, (n, n), rows and columns in the order of the arm."""
        order = [list(self.joints).index(name) for name in arm.names]
        return np.eye(arm.size) if self.gears is None else np.array(self.gears)[np.ix_(order, order)]
