"""An arm as a machine: what services, pages, fleets and commands know of one."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Never

from servoscope.arm.baseline import ArmBaseline
from servoscope.arm.log import ArmRecording, read_arm_log
from servoscope.arm.settings import ArmLoop
from servoscope.baseline.records import BaselineSource
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, NotEnoughError
from servoscope.core.messages import Message, message, render, say
from servoscope.machines.protocol import Catch, LogDiagnosis, WindowDiagnosis
from servoscope.models.loop import Loop


class ArmMachine:
    """An arm with its baseline; nothing is known of it between two windows."""

    kind = "arm"
    needs_channels_alone = True
    points: tuple[str, ...] = ()
    point = ""
    units = None
    loop_baseline = None

    def __init__(self, baseline: ArmBaseline) -> None:
        self.baseline = baseline

    @classmethod
    def load(cls, path: str | Path) -> ArmMachine:
        """Read the file of a baseline; raises BaselineError if it cannot be used."""
        baseline = ArmBaseline.load(path)
        if baseline is None:
            raise BaselineError(f'{path}: is no baseline of an arm, give one that learn wrote for kind = "arm"')
        return cls(baseline)

    @classmethod
    def parse(cls, text: str) -> ArmMachine:
        """Return what `to_json` has written."""
        return cls(ArmBaseline.parse(text))

    @classmethod
    def learn(cls, loop: Path, logs: Sequence[Path], catch: Catch) -> ArmMachine:
        """Learn from healthy logs and a loop file; each log is read within a context of `catch`."""
        from servoscope.arm.learning import learn_arm

        settings, urdf = ArmLoop.load(loop)
        arm, recordings = settings.kinematics(urdf, settings.urdf), list[ArmRecording]()
        for path in logs:
            with catch():
                recordings.append(read_arm_log(path, settings, arm))
        if not recordings:
            raise NotEnoughError(f"{loop}: none of its logs can be used")
        return cls(learn_arm(settings, urdf, recordings))

    @staticmethod
    def propose(log: Path, urdf: Path, folder: Path) -> str:
        """Return a proposal for the loop file in a folder, from a log and a URDF."""
        from servoscope.arm.setup import propose_arm_loop

        loop, why = propose_arm_loop(log, urdf, os.path.relpath(urdf, folder))
        return loop.to_toml({key: render(reason) for key, reason in why.items()})

    def calibrate(self, log: Path, mass: float) -> tuple[str, list[tuple[str, str]], list[str]]:
        """Return the loop file with drive gains from a log with a known mass [kg], their table, and joints without."""
        from servoscope.arm.setup import calibrate_load

        loop = self.baseline.loop
        gains = calibrate_load(self.baseline, self.read(log), mass)
        joints = {
            gain.joint: loop.joints[gain.joint].model_copy(
                update={"gain": float(f"{gain.gain:.4g}")} if gain.determined else {}
            )
            for gain in gains
        }
        calibrated = loop.model_copy(update={"joints": {name: joints[name] for name in loop.joints}, "gains": "load"})
        rows = [(gain.joint, f"{gain.gain:.4g} ± {1.96 * gain.std * abs(gain.gain):.2g}") for gain in gains]
        return calibrated.to_toml({}), rows, [gain.joint for gain in gains if not gain.determined]

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind."""
        self.baseline.save(path)

    def to_json(self) -> str:
        """Return the baseline as text."""
        return self.baseline.to_text()

    @property
    def name(self) -> str:
        """Of the loop file."""
        return self.baseline.loop.name

    @cached_property
    def hash(self) -> str:
        """A digest of the baseline."""
        return self.baseline.hash

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.baseline.loop.sample_rate

    @cached_property
    def carrier(self) -> Loop:
        """The first joint as a loop, with the columns of all."""
        return self.baseline.loop.carrier

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of the signals of all joints."""
        return tuple(self.baseline.loop.channels)

    @property
    def sources(self) -> tuple[BaselineSource, ...]:
        """The recordings that it was learned from."""
        return self.baseline.sources

    @property
    def coefficient_units(self) -> tuple[str, ...]:
        """Units of the coefficients of its diagnoses."""
        return self.baseline.coefficient_units

    @cached_property
    def fault_words(self) -> Mapping[str, str]:
        """The names of its faults, which say what they mean."""
        return {name: name for name in self.baseline.fault_names}

    def at(self, point: str) -> Never:
        """Raise BaselineError."""
        raise BaselineError("an arm has no operating points, leave it out")

    def summary(self) -> Mapping[str, Any]:
        """Return friction and the share of unexplained torque of each joint, as plain values."""
        return self.baseline.summary()

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]], list[str]]:
        """Return friction and the share of unexplained torque of each joint, and notes."""
        rows = [
            (
                name,
                *(f"{value:.4g} ± {1.96 * std:.2g}" for value, std in joint["friction"]),
                f"{joint['unexplained']:.1%}",
            )
            for name, joint in self.baseline.summary()["joints"].items()
        ]
        unsure = self.baseline.undetermined
        notes = [say("arm.undetermined_friction", names=unsure)] if unsure else []
        head = "joint", "viscous friction", "Coulomb friction", "unexplained"
        return head, rows, [*notes, *map(str, self.baseline.notes)]

    def checks(self, fault: str) -> tuple[Message, ...]:
        """Return what to check for one of its faults."""
        kind = fault.partition(" of ")[0]
        known = any(cause.kind == kind for cause in self.baseline.causes)
        return (message(f"arm.check.{kind.replace(' ', '_')}"),) if known else ()

    def follower(self) -> None:
        """Return nothing: torques need minutes to say something of the joints."""

    def read(self, source: str | Path) -> ArmRecording:
        """Read a whole log; raises RecordingError if it cannot be used."""
        return read_arm_log(source, self.baseline.loop, self.baseline.model.arm)

    def judge(self, log: ArmRecording, progress: Callable[[str], None]) -> LogDiagnosis:
        """Judge a log; how the arm is drawn is the key ``arm``."""
        from servoscope.arm.diagnosis import examine_arm

        progress("joints")
        diagnosis, exam = examine_arm(self.baseline, log)

        def write_report(path: Path, baseline: str, recording: str) -> None:
            from servoscope.arm.page import write_arm_page  # late: it draws

            write_arm_page(path, diagnosis, exam, self.baseline)

        picture = exam.picture(self.baseline, diagnosis)
        data = {"words": {}, "units": ("", ""), "signals": None, "trace": None, "arm": picture}
        return LogDiagnosis(diagnosis, data, self.hash, write_report)

    def judge_window(self, name: str, signals: FloatArray) -> WindowDiagnosis:
        """Judge a window; the evidence and how the arm is drawn are the details ``evidence`` and ``arm``."""
        from servoscope.arm.diagnosis import examine_window

        t, _, _, _, *own = signals
        diagnosis, exam, start, excess = examine_window(
            self.baseline, name, t, dict(zip(self.channels, own, strict=True))
        )
        details = {"evidence": excess, "arm": exam.picture(self.baseline, diagnosis)}
        return WindowDiagnosis(diagnosis, start, excess, details)
