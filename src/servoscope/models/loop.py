"""What the user knows about one closed loop, read from TOML, checked once and frozen."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializeAsAny, ValidationError, field_validator, model_validator

from servoscope.core.errors import LoopError, ObsoleteSettingWarning
from servoscope.core.settings import Finite, NonEmptyStr, NonNegative, Positive, Settings, parse_toml, read_toml_text
from servoscope.core.settings_errors import describe_error
from servoscope.core.short_repr import ShortRepr
from servoscope.models import plants
from servoscope.models.columns import Columns as Columns
from servoscope.models.columns import TextLayout as TextLayout

DEFAULT_FREQUENCIES = (1.0, 10.0, 20.0)
FEATURE_FALSE_ALARMS = 0.005
COVARIATE_HOLD_S = 600.0  # a thermometer may tell rarely, and only what has changed
RESERVED_FAULTS = ("unknown", "healthy", "sensor_gain", "delay", "backlash")  # names that mean something else
MAX_DELAY_SAMPLES = 100  # samples; a longer one is a delay in ms given as s, as a rule
MIN_DEFAULT_MEMORY = 50.0  # samples; a shorter memory hardly averages noise
MIN_FREQUENCY_SHARE = 1e-6  # of the sample rate: a slower filter would take millions of samples to settle

Interval = tuple[Finite, Finite]


class Controller(Settings):
    """Discrete PI controller with feed-forward, u(k) = k_p e(k) + k_i T sum e + k_v (r(k) - r(k-1))/T, e = r - y."""

    kind: Literal["pi"]
    k_p: Positive
    k_i: NonNegative
    # feed-forward of the reference's speed; hashes of loops without it stay as they were
    k_v: Annotated[NonNegative, Field(exclude_if=lambda value: value == 0.0)] = 0.0


class MonitorSettings(Settings):
    """How the loop is watched; every setting has a default."""

    # ``svf``, state-variable filter, ``tustin``, the paper's discretisation, or ``tustin-held``, the same with (u(k) +
    # u(k-1))/2 in place of u, which suits a held input
    structure: Literal["svf", "tustin", "tustin-held"] = "svf"
    # cutoff of the state-variable filter [Hz]; None: chosen from the sample rate and the loop's bandwidth
    cutoff: Positive | None = None
    estimator: NonEmptyStr = "akf"  # name of a recursive estimator
    # ``adaptive`` puts the paper's stage 1 in front: u_a, simulated from r, takes the place of u
    two_stage: Literal["none", "adaptive"] = "none"
    # what stage 1 makes of r: ``fir``, its past samples, or ``laguerre``, Laguerre functions
    stage_one: Literal["fir", "laguerre"] = "fir"
    # how many of them; None: 40 samples or 12 functions
    stage_one_length: Annotated[int, Field(strict=True, ge=1, le=500)] | None = None
    stage_one_pole: Annotated[Finite, Field(gt=-1.0, lt=1.0)] = 0.5  # pole of the Laguerre functions, per sample
    memory: Positive = 5.0  # memory of the estimator [s]; at least 50 samples where the file does not say
    # the same in samples, in the place of seconds
    memory_samples: Annotated[int, Field(strict=True, ge=2)] | None = None
    # share of u (rms) that the model may leave unexplained, 0 to 1
    model_error: Annotated[NonNegative, Field(lt=1.0)] = 0.0
    # when the estimator may learn: ``auto``, until the axis has stood still for longer than the filters remember (a
    # loop that can be simulated learns at rest too, which is then expected); ``always``; ``moving``, neither at the
    # shortest rest nor inside the dead zone
    update_when: Literal["auto", "always", "moving"] = "auto"
    rest_speed: NonNegative = 0.0  # speed [output per s] below which the output counts as resting
    evaluation_rate: Positive = 10.0  # how often iFRF, residual and statistic are evaluated [Hz]
    # when the sequential test decides: once per ``evaluation``, by what the updates since the one before sum up to, or
    # at every ``update`` of the estimator, as baselines of earlier versions do; obsolete in loop files
    sequential_step: Literal["update", "evaluation"] = "evaluation"
    # monitored frequencies [Hz]
    frequencies: Annotated[tuple[Positive, ...], Field(min_length=1)] = DEFAULT_FREQUENCIES
    false_alarms_per_year: Positive = 1.0  # budget that the alarm is set for, after its delays
    # share of healthy recordings that the features beside the coefficients may call changed; 0: no features
    feature_false_alarms: Annotated[
        float, Field(ge=0.0, le=0.5, exclude_if=lambda value: value == FEATURE_FALSE_ALARMS)
    ] = FEATURE_FALSE_ALARMS
    # how long a value of a covariate holds without a new one [s]
    covariate_hold_s: Annotated[Positive, Field(exclude_if=lambda value: value == COVARIATE_HOLD_S)] = COVARIATE_HOLD_S
    # whether coefficients follow a warm-up that no column tells
    hidden_warm_up: bool = Field(default=False, exclude_if=lambda value: not value)
    on_delay: NonNegative = 0.0  # how long a limit must be exceeded before the alarm is raised [s]
    # how long the alarm stays after the limit was exceeded last [s]; None: for the memory
    off_delay: NonNegative | None = None


class Loop(ShortRepr, Settings):
    """One closed loop: sampling, columns, plant, controller and how it is monitored.

    Examples
    --------
    >>> Loop.load("loop.toml").sample_rate
    200.0
    """

    name: NonEmptyStr = "loop"  # what the loop is called in reports
    sample_rate: Positive  # sample rate of r, u and y [Hz]
    hold: Literal["zoh", "foh"] = "zoh"  # how the controller holds u between samples
    delay: NonNegative = 0.0  # from u as logged to u acting [s]
    # whether u was logged after or before the limiter; before it, `input_limits` is needed
    input_logged: Literal["after_limiter", "before_limiter"] = "after_limiter"
    input_limits: Interval | None = None  # limits [lo, hi] of u
    input_deadzone: Interval | None = None  # range [lo, hi] of u in which the valve is shut
    # what `learn` does with coefficients that no machine has, or that explain less than half of u: ``note`` where u
    # only stands in for the force of the drive
    implausible: Literal["refuse", "note"] = Field(default="refuse", exclude_if=lambda value: value == "refuse")
    # columns, plant, controller, monitor: the sections of the file; the controller is optional
    columns: Columns = Columns()
    plant: SerializeAsAny[plants.Plant]
    controller: Controller | None = None
    monitor: MonitorSettings = MonitorSettings()
    # faults that move several parameters at once: by name, the ratios of the parameters at full size
    faults: dict[NonEmptyStr, dict[NonEmptyStr, Positive]] | None = None
    checks: dict[NonEmptyStr, tuple[NonEmptyStr, ...]] | None = None  # by fault: what to check on the machine

    @field_validator("checks", mode="before")
    @classmethod
    def _one_or_several(cls, value: object) -> object:
        if not isinstance(value, Mapping):
            return value
        return {name: [names] if isinstance(names, str) else names for name, names in value.items()}

    @field_validator("plant", mode="before")
    @classmethod
    def _parse_plant(cls, value: object) -> object:
        return plants.parse_plant(value) if isinstance(value, Mapping) else value

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
        defaults: dict[str, Any] = {"frequencies": frequencies, "evaluation_rate": evaluation}
        if isinstance(monitor, Mapping):
            updates["monitor"] = {**defaults, "memory": _default_memory(monitor, rate), **monitor}
        elif isinstance(monitor, MonitorSettings):
            defaults["memory"] = _default_memory(monitor.model_dump(exclude_unset=True), rate)
            kept = {key: value for key, value in defaults.items() if key not in monitor.model_fields_set}
            updates["monitor"] = monitor.model_copy(update=kept)
        if isinstance(plant, plants.Plant):
            updates["plant"] = plant.with_sample_rate(rate)
        return {**data, **updates}

    @model_validator(mode="after")
    def _rays_of_plant(self) -> Self:
        if self.faults or self.plant.rays:
            rays = tuple(self._check_ray(name, ratios) for name, ratios in (self.faults or {}).items())
            # a frozen model may still be completed while it is made
            object.__setattr__(self, "plant", self.plant.with_rays(rays))
        return self

    def _check_ray(self, name: str, ratios: Mapping[str, float]) -> plants.FaultRay:
        """Return the fault that a table of the file defines."""
        own = [fault.name for fault in self.plant.faults]
        if name in (*own, *self.plant.parameters, *self.plant.causes, *RESERVED_FAULTS) or " + " in name:
            taken = ", ".join(dict.fromkeys([*own, *self.plant.parameters, *RESERVED_FAULTS]))
            raise ValueError(f"[faults.{name}]: the name is taken ({taken} are), give the fault another")
        known = (*self.plant.parameters, *self.plant.causes)
        for parameter, ratio in ratios.items():
            if parameter not in known:
                raise ValueError(f"[faults.{name}] {parameter}: unknown, choose from {', '.join(known)}")
            if ratio == 1.0:
                raise ValueError(f"[faults.{name}] {parameter}: a ratio of 1 changes nothing, leave it out")
        if len(ratios) < 2:
            raise ValueError(f"[faults.{name}]: needs the ratios of two or more parameters, as inertia = 2.0")
        return plants.FaultRay(name, tuple(ratios.items()))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        nyquist = self.sample_rate / 2
        checked = [("[monitor] cutoff", self.monitor.cutoff)]
        checked += [("[monitor] frequencies", frequency) for frequency in self.monitor.frequencies]
        checked += [("[plant] sign_cutoff", self.plant.velocity_sign.cutoff)]
        for key, frequency in checked:
            if frequency is not None and frequency >= nyquist:
                raise ValueError(
                    f"{key}: {frequency:g} Hz is not below the Nyquist frequency of {nyquist:g} Hz"
                    f" (sample_rate = {self.sample_rate:g} Hz), lower it"
                )
            if frequency is not None and frequency < MIN_FREQUENCY_SHARE * self.sample_rate:
                raise ValueError(
                    f"{key}: {frequency:g} Hz is below a millionth of sample_rate = {self.sample_rate:g} Hz, raise it"
                )
        if len(set(self.monitor.frequencies)) < len(self.monitor.frequencies):
            raise ValueError("[monitor] frequencies: a frequency stands twice, remove one")
        if self.monitor.hidden_warm_up and self.columns.covariates:
            raise ValueError("[monitor] hidden_warm_up: for where nothing is logged, not beside [columns.covariates]")
        if self.monitor.evaluation_rate > self.sample_rate:
            rates = f"{self.monitor.evaluation_rate:g} Hz is above sample_rate = {self.sample_rate:g} Hz"
            raise ValueError(f"[monitor] evaluation_rate: {rates}, lower it")
        if self.monitor.memory * self.sample_rate < 2:
            seconds = self.monitor.memory
            raise ValueError(f"[monitor] memory: {seconds:g} s is shorter than two samples, give it in seconds")
        if self.monitor.update_when == "moving" and not (self.monitor.rest_speed or self.input_deadzone):
            raise ValueError(
                '[monitor] rest_speed: missing, update_when = "moving" needs the speed below which the axis rests '
                "(inspect tells one), or input_deadzone"
            )
        if self.delay * self.sample_rate > MAX_DELAY_SAMPLES:
            raise ValueError(f"delay: {self.delay:g} s is more than {MAX_DELAY_SAMPLES} samples, give it in seconds")
        for key, interval in (("input_limits", self.input_limits), ("input_deadzone", self.input_deadzone)):
            if interval is not None and interval[0] >= interval[1]:
                raise ValueError(f"{key}: [{interval[0]:g}, {interval[1]:g}] must be [lo, hi] with lo below hi")
        if self.input_logged == "before_limiter" and self.input_limits is None:
            raise ValueError('input_limits: missing, input_logged = "before_limiter" needs input_limits = [lo, hi]')
        return self

    @property
    def cutoff(self) -> float:
        """Cutoff of the state-variable filter [Hz]: the file's, or a tenth of the sample rate.

        A tenth leaves ten samples per period at the cutoff, where the hold on y is still good.
        """
        return self.monitor.cutoff if self.monitor.cutoff is not None else self.sample_rate / 10.0

    @property
    def needs_reference(self) -> bool:
        """Whether r has a part in the loop; elsewhere u may stand for it in recordings that have none."""
        of_sign = self.plant.velocity_sign.of_reference
        return self.controller is not None or self.monitor.two_stage != "none" or of_sign

    def _shown_facts(self) -> dict[str, object]:
        cutoff = self.monitor.cutoff
        return {
            "name": self.name,
            "rate": f"{self.sample_rate:g} Hz",
            "plant": self.plant.kind,
            "controller": self.controller.kind if self.controller is not None else "none",
            "cutoff": f"{cutoff:g} Hz" if cutoff is not None else "by itself",
        }

    @classmethod
    def of(cls, source: Loop | str | Path) -> Loop:
        """Return a loop as it is, or read it from a path; raises TypeError if it is neither."""
        if isinstance(source, Loop):
            return source
        if not isinstance(source, str | Path):
            raise TypeError(f"a loop is a Loop or the path of a loop file, not {type(source).__name__}")
        return cls.load(source)

    @classmethod
    def load(cls, path: str | Path) -> Loop:
        """Read a loop file.

        Raises LoopError if the file cannot be read, is not TOML, or a setting in it is wrong.
        """
        path = Path(path)
        return cls.from_text(read_toml_text(path, "loop file", LoopError), str(path))

    @classmethod
    def from_text(cls, text: str, source: str) -> Loop:
        """Return the loop that the text of a loop file describes; error messages call it `source`."""
        settings = parse_toml(text, source, LoopError)
        monitor = settings.get("monitor")
        # `to_dict` writes the value that is left, so files that hold it are as good as those without it
        if isinstance(monitor, Mapping) and monitor.get("sequential_step", "evaluation") != "evaluation":
            warnings.warn(
                f"{source}: [monitor] sequential_step: is no setting any more, leave it out: the sequential test "
                "decides once per evaluation, and a higher evaluation_rate makes its alarms faster",
                ObsoleteSettingWarning,
                stacklevel=2,
            )
        return cls.from_dict(settings, source)

    @classmethod
    def from_dict(cls, mapping: Mapping[str, Any], source: str = "loop") -> Loop:
        """Build a loop from nested mappings laid out like the loop file.

        Parameters
        ----------
        mapping
            Tables ``columns``, ``plant``, ``controller``, ``monitor`` and the keys before them.
        source
            What error messages call it, for example the file's name.

        Raises LoopError if a key is unknown or missing or a value is wrong.

        Examples
        --------
        >>> plant = {"kind": "polynomial", "order": 2, "friction": "coulomb"}
        >>> Loop.from_dict({"sample_rate": 1000.0, "plant": plant}).plant.names
        ('viscous_friction', 'inertia', 'coulomb_friction')
        """
        if not isinstance(mapping, Mapping):
            raise LoopError(f"{source}: must be a table of settings, found {type(mapping).__name__}")
        data = dict(mapping)
        if isinstance(kind := data.get("kind"), str):
            taken = "learn and diagnose take it where its package is installed, services take its baseline"
            raise LoopError(f"{source}: describes a machine of kind {kind!r}, which is no loop: {taken}")
        if isinstance(data.get("plant"), Mapping):
            data["plant"] = _parse_plant_table(data["plant"], source)
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise LoopError(f"{source}: {describe_error(error, cls)}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain values, ready for JSON, that `from_dict` turns into an equal loop."""
        plain: dict[str, Any] = self.model_dump(mode="json")
        # came later, as what `exclude_if` leaves out: hashes of loops without them stay as they were
        for key in ("text", "resample", "time_zone", "covariates"):
            if not plain["columns"][key]:
                del plain["columns"][key]
        del plain["monitor"]["memory" if self.monitor.memory_samples else "memory_samples"]
        return {key: value for key, value in plain.items() if value is not None}

    def hash(self) -> str:
        """Return a digest of all settings, the same on every machine: 16 hexadecimal digits."""
        plain = self.to_dict()
        if self.monitor.sequential_step == "update":
            del plain["monitor"]["sequential_step"]  # what loops meant that were hashed before it came
        canonical = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _default_memory(monitor: Mapping[str, Any], rate: float) -> float:
    """Return the memory [s] of a table that gives it in samples, or not at all."""
    samples = monitor.get("memory_samples")
    if samples is None:
        return max(float(MonitorSettings.model_fields["memory"].default), MIN_DEFAULT_MEMORY / rate)
    if "memory" in monitor:
        raise ValueError("[monitor] memory_samples: stands for memory, given in samples: remove one of them")
    return samples / rate if isinstance(samples, int) else MIN_DEFAULT_MEMORY / rate


def _parse_plant_table(mapping: Mapping[str, Any], source: str) -> plants.Plant:
    try:
        if "kind" not in mapping:
            return plants.parse_plant(mapping)
        plant = plants.plant_class(mapping["kind"])
    except LoopError as error:
        raise LoopError(f"{source}: {error}") from None
    try:
        # Strict, so that "4.0" in quotes or `true` is refused as in every other section.
        return plant.model_validate(dict(mapping), strict=True)
    except ValidationError as error:
        raise LoopError(f"{source}: {describe_error(error, plant, section='plant')}") from None
