"""What the user knows about one closed loop, read from TOML, checked once and frozen."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    SerializeAsAny,
    ValidationError,
    field_validator,
    model_validator,
)

from servoscope import plants
from servoscope.complaints import describe
from servoscope.errors import LoopError
from servoscope.settings import Finite, NotNegative, Positive, Settings, Word, parsed, text_of

__all__ = ["DEFAULT_FREQUENCIES", "Columns", "Controller", "Loop", "MonitorSettings"]

DEFAULT_FREQUENCIES = (1.0, 10.0, 20.0)
LONGEST_DELAY = 100  # samples; a longer one is a delay in ms given as s, as a rule

Interval = tuple[Finite, Finite]


class Columns(Settings):
    """Where the signals stand in a recording.

    Parameters
    ----------
    time
        Column of the time stamps; None when there is none and the samples are uniform.
    reference, input, output
        Columns of r, u, y, or linear combinations of columns, for example ``"set_point - position_error"``.
    time_unit
        Unit of a numeric time column.
    segment
        Columns whose change starts a new run; a time reset does too.
    """

    time: Word | None = "t"
    reference: Word = "r"
    input: Word = "u"
    output: Word = "y"
    time_unit: Literal["s", "ms", "us", "ns", "min"] = "s"
    segment: tuple[Word, ...] = ()


class Controller(Settings):
    """Discrete PI controller, u(k) = k_p e(k) + k_i T sum e, e = r - y."""

    kind: Literal["pi"]
    k_p: Positive
    k_i: NotNegative


class MonitorSettings(Settings):
    """How the loop is watched; every setting has a default.

    Parameters
    ----------
    structure
        ``svf``, state-variable filter, ``tustin``, the paper's discretisation, or ``tustin-held``, the same
        with (u(k) + u(k-1))/2 in place of u, which suits a held input.
    cutoff
        Cutoff of the state-variable filter [Hz]; None: chosen from the sample rate and the loop's bandwidth.
    estimator
        Name of a recursive estimator.
    two_stage
        ``adaptive`` puts the paper's stage 1 in front: u_a, simulated from r, takes the place of u.
    stage_one
        What stage 1 makes of r: ``fir``, its past samples, or ``laguerre``, Laguerre functions.
    stage_one_length
        How many of them; None: 40 samples or 12 functions.
    stage_one_pole
        Pole of the Laguerre functions, per sample.
    memory
        Memory of the estimator [s].
    model_error
        Share of u (rms) that the model may leave unexplained, 0 to 1.
    update_when
        When the estimator may learn: ``auto``, until the axis has stood still for longer than the filters remember
        (a loop that can be simulated learns at rest too, which is then expected); ``always``; ``moving``, neither at
        the shortest rest nor inside the dead zone.
    rest_speed
        Speed [output per s] below which the output counts as resting.
    evaluation_rate
        How often iFRF, residual and statistic are evaluated [Hz].
    frequencies
        Monitored frequencies [Hz].
    false_alarms_per_year
        Budget that the alarm is set for, after its delays.
    on_delay
        How long a limit must be exceeded before the alarm is raised [s].
    off_delay
        How long the alarm stays after the limit was exceeded last [s]; None: for the memory.
    """

    structure: Literal["svf", "tustin", "tustin-held"] = "svf"
    cutoff: Positive | None = None
    estimator: Word = "akf"
    two_stage: Literal["none", "adaptive"] = "none"
    stage_one: Literal["fir", "laguerre"] = "fir"
    stage_one_length: Annotated[int, Field(strict=True, ge=1, le=500)] | None = None
    stage_one_pole: Annotated[Finite, Field(gt=-1.0, lt=1.0)] = 0.5
    memory: Positive = 5.0
    model_error: Annotated[NotNegative, Field(lt=1.0)] = 0.0
    update_when: Literal["auto", "always", "moving"] = "auto"
    rest_speed: NotNegative = 0.0
    evaluation_rate: Positive = 10.0
    frequencies: Annotated[tuple[Positive, ...], Field(min_length=1)] = DEFAULT_FREQUENCIES
    false_alarms_per_year: Positive = 1.0
    on_delay: NotNegative = 0.0
    off_delay: NotNegative | None = None


class Loop(Settings):
    """One closed loop: sampling, columns, plant, controller and how it is monitored.

    Parameters
    ----------
    name
        What the loop is called in reports.
    sample_rate
        Sample rate of r, u and y [Hz].
    hold
        How the controller holds u between samples.
    delay
        From u as logged to u acting [s].
    input_logged
        Whether u was logged after or before the limiter; before it, `input_limits` is needed.
    input_limits
        Limits [lo, hi] of u.
    input_deadzone
        Range [lo, hi] of u in which the valve is shut.
    columns, plant, controller, monitor
        The sections of the file; the controller is optional.
    """

    name: Word = "loop"
    sample_rate: Positive
    hold: Literal["zoh", "foh"] = "zoh"
    delay: NotNegative = 0.0
    input_logged: Literal["after_limiter", "before_limiter"] = "after_limiter"
    input_limits: Interval | None = None
    input_deadzone: Interval | None = None
    columns: Columns = Columns()
    plant: SerializeAsAny[plants.Plant]
    controller: Controller | None = None
    monitor: MonitorSettings = MonitorSettings()

    @field_validator("plant", mode="before")
    @classmethod
    def _parse_plant(cls, value: object) -> object:
        return plants.parse(value) if isinstance(value, Mapping) else value

    @model_validator(mode="before")
    @classmethod
    def _defaults_below_nyquist(cls, data: Any) -> Any:
        """Let defaults give way to a slow sample rate; what the user wrote is never changed."""
        rate = data.get("sample_rate") if isinstance(data, Mapping) else None
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 < rate < float("inf"):
            return data
        monitor, plant = data.get("monitor", {}), data.get("plant")
        updates: dict[str, Any] = {}
        frequencies = tuple(f for f in DEFAULT_FREQUENCIES if f < rate / 2) or (rate / 10,)
        evaluation = min(MonitorSettings.model_fields["evaluation_rate"].default, float(rate))
        if isinstance(monitor, Mapping):
            updates["monitor"] = {"frequencies": frequencies, "evaluation_rate": evaluation, **monitor}
        elif isinstance(monitor, MonitorSettings):
            slow = {"frequencies": frequencies, "evaluation_rate": evaluation}
            kept = {key: value for key, value in slow.items() if key not in monitor.model_fields_set}
            updates["monitor"] = monitor.model_copy(update=kept)
        if isinstance(plant, plants.Plant) and "sign_cutoff" not in plant.model_fields_set:
            sign_cutoff = getattr(plant, "sign_cutoff", None)
            if sign_cutoff is not None and sign_cutoff >= rate / 2:
                updates["plant"] = plant.model_copy(update={"sign_cutoff": rate / 4})
        return {**data, **updates}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        nyquist = self.sample_rate / 2
        checked = [("[monitor] cutoff", self.monitor.cutoff)]
        checked += [("[monitor] frequencies", frequency) for frequency in self.monitor.frequencies]
        checked += [("[plant] sign_cutoff", getattr(self.plant, "sign_cutoff", None))]
        for key, frequency in checked:
            if frequency is not None and frequency >= nyquist:
                raise ValueError(
                    f"{key}: {frequency:g} Hz is not below the Nyquist frequency of {nyquist:g} Hz"
                    f" (sample_rate = {self.sample_rate:g} Hz), lower it"
                )
        if len(set(self.monitor.frequencies)) < len(self.monitor.frequencies):
            raise ValueError("[monitor] frequencies: a frequency stands twice, remove one")
        if self.monitor.evaluation_rate > self.sample_rate:
            raise ValueError(
                f"[monitor] evaluation_rate: {self.monitor.evaluation_rate:g} Hz is above"
                f" sample_rate = {self.sample_rate:g} Hz, lower it"
            )
        if self.monitor.memory * self.sample_rate < 2:
            raise ValueError(
                f"[monitor] memory: {self.monitor.memory:g} s is shorter than two samples, give it in seconds"
            )
        if self.monitor.update_when == "moving" and not (self.monitor.rest_speed or self.input_deadzone):
            raise ValueError(
                '[monitor] rest_speed: missing, update_when = "moving" needs the speed below which the axis rests '
                "(inspect tells one), or input_deadzone"
            )
        if self.delay * self.sample_rate > LONGEST_DELAY:
            raise ValueError(f"delay: {self.delay:g} s is more than {LONGEST_DELAY} samples, give it in seconds")
        for key, interval in (("input_limits", self.input_limits), ("input_deadzone", self.input_deadzone)):
            if interval is not None and interval[0] >= interval[1]:
                raise ValueError(f"{key}: [{interval[0]:g}, {interval[1]:g}] must be [lo, hi] with lo below hi")
        if self.input_logged == "before_limiter" and self.input_limits is None:
            raise ValueError('input_limits: missing, input_logged = "before_limiter" needs input_limits = [lo, hi]')
        return self

    @classmethod
    def load(cls, path: str | Path) -> Loop:
        """Read a loop file.

        Raises
        ------
        LoopError
            If the file cannot be read, is not TOML, or a setting in it is wrong.
        """
        path = Path(path)
        return cls.from_dict(parsed(text_of(path, "loop file", LoopError), path, LoopError), source=str(path))

    @classmethod
    def from_dict(cls, mapping: Mapping[str, Any], source: str = "loop") -> Loop:
        """Build a loop from nested mappings laid out like the loop file.

        Parameters
        ----------
        mapping
            Tables ``columns``, ``plant``, ``controller``, ``monitor`` and the keys before them.
        source
            What error messages call it, for example the file's name.

        Raises
        ------
        LoopError
            If a key is unknown or missing or a value is wrong.
        """
        if not isinstance(mapping, Mapping):
            raise LoopError(f"{source}: must be a table of settings, found {type(mapping).__name__}")
        data = dict(mapping)
        if isinstance(data.get("plant"), Mapping):
            data["plant"] = _plant(data["plant"], source)
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise LoopError(f"{source}: {describe(error, cls)}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain values, ready for JSON, that `from_dict` turns into an equal loop."""
        plain: dict[str, Any] = self.model_dump(mode="json")
        return {key: value for key, value in plain.items() if value is not None}

    def hash(self) -> str:
        """Return a digest of all settings, the same on every machine: 16 hexadecimal digits."""
        canonical = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _plant(mapping: Mapping[str, Any], source: str) -> plants.Plant:
    try:
        if "kind" not in mapping:
            return plants.parse(mapping)
        found = plants.plant_class(mapping["kind"])
    except LoopError as error:
        raise LoopError(f"{source}: {error}") from None
    try:
        # Strict, so that "4.0" in quotes or `true` is refused as in every other section.
        return found.model_validate(dict(mapping), strict=True)
    except ValidationError as error:
        raise LoopError(f"{source}: {describe(error, found, section='plant')}") from None
