"""What healthy looks like: learned from recordings or computed from nominal parameters; one JSON file, versioned."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from servoscope.baseline.learned_evidence import LearnedEvidence
from servoscope.baseline.learned_fault import LearnedFault
from servoscope.baseline.motion import MotionRange
from servoscope.baseline.plant_fit import fault_directions, match_ratios
from servoscope.baseline.records import (
    AlarmThresholds,
    BaselineSource,
    Detectability,
    ExactPredictorFit,
    HealthyParameters,
    HealthyScatter,
    Matrix,
    RecursionTuning,
    Revision,
    Vector,
    is_covariance,
    parse_stored_loop,
)
from servoscope.baseline.threshold import t2_threshold
from servoscope.baseline.version_2 import FLAT_VERSION, group_flat_fields
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, LoopError
from servoscope.core.files import atomic_write
from servoscope.core.messages import MessageText
from servoscope.core.short_repr import ShortRepr
from servoscope.estimation.filter_bank import nominal_theta
from servoscope.estimation.pipeline import Pipeline, Tuning
from servoscope.models.loop import Loop
from servoscope.models.plants import Plant
from servoscope.signals.recording import frame_of

FORMAT = "servoscope-baseline"
OTHER_FORMAT = re.compile(r"servoscope-(\w+)-baseline")  # of machines that are no loops
VERSION = 3
SETTLED_MEMORIES = 3.0  # memories, after which 5 % of the start are left


class Baseline(ShortRepr, LearnedEvidence):
    """What a healthy loop looks like to the monitor; everything that `diagnose` needs.

    Parameters
    ----------
    loop, sources, hash
        The loop, as in its file, and what it was learned from.
    names, theta, covariance
        The n coefficients: names, healthy values (n,), and the covariance (n, n) of a further healthy recording's mean
        around them: noise of the baseline, scatter between recordings and model error.
    recursion, healthy, scatter, thresholds, detectability
        What the steps of learning found: the recursion's tuning; the healthy plant and its noise; how the recordings
        scatter; limits of both tests; the smallest changes and the budget that the recordings support.
    delay_s
        Delay that the recordings show [s]; None where they do not show it.
    notes, learned
        Warnings of `learn`; faults known from labelled recordings.
    exact
        What the exact predictor says of the healthy recordings; None where there is none.
    sensors, features, motion, axis, covariates, residual, pressures
        Further evidence, None where there is none: how the sensors of the output disagree; what four or more recordings
        show besides coefficients; the motion that they hold; the healthy motor axis that its refit starts from; how
        coefficients move with covariates, theta being theirs in the middle of the learned range; what these leave of u;
        what logged pressures of a cylinder show.
    point, others
        Name of the operating point, empty where none was declared; the baselines of the other points. A baseline with
        others is itself that of the first point.
    revision
        Its place in its history: what was relearned, when, by whom and why.

    Examples
    --------
    >>> Baseline.load("baseline.json").names
    ('viscous_friction', 'inertia', 'coulomb_friction', 'offset')
    """

    loop_settings: dict[str, Any] = Field(alias="loop")
    sources: tuple[BaselineSource, ...]
    hash: str
    names: tuple[str, ...]
    theta: Vector
    covariance: Matrix
    recursion: RecursionTuning
    healthy: HealthyParameters
    scatter: HealthyScatter
    thresholds: AlarmThresholds
    detectability: Detectability
    delay_s: float | None
    notes: tuple[MessageText, ...]
    learned: tuple[LearnedFault, ...] = ()
    exact: ExactPredictorFit | None = None
    point: str = ""
    others: tuple[Baseline, ...] = ()
    revision: Revision = Revision()

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        n, tuning = len(self.names), self.recursion
        for where, vector in (("theta", self.theta), ("recursion.scale", tuning.scale)):
            if len(vector) != n:
                raise ValueError(f"{where} must have {n} values, one per coefficient")
        for where, rows in (("covariance", self.covariance), ("recursion.P_d", tuning.P_d)):
            if len(rows) != n or any(len(row) != n for row in rows):
                raise ValueError(f"{where} must be {n} by {n}")
        gamma = tuning.noise_gamma
        if not gamma or len(gamma) != len(tuning.noise_a) or not (gamma[0] > 0.0 and tuning.noise_variance > 0.0):
            raise ValueError("noise_a and noise_gamma must have the same length, and a positive variance")
        if len(self.healthy.theta) not in (0, n):
            raise ValueError(f"healthy.theta must be empty or have {n} values")
        if not (n and tuning.R > 0.0 and self.thresholds.statistic > 0.0 and min(tuning.scale) > 0.0):
            raise ValueError("names, R, threshold and scale must be positive")
        if not is_covariance(self.covariance):
            raise ValueError("covariance must be symmetric and positive")
        if any(len(fault.deviation) != n for fault in self.learned):
            raise ValueError(f"learned must have deviations of {n} values, one per coefficient")
        if len({fault.name for fault in self.learned}) < len(self.learned):
            raise ValueError("learned must have names of their own")
        if self.others and (not all(self.points) or len(set(self.points)) < len(self.points)):
            raise ValueError("point must be a name of its own at every operating point")
        if any(other.others for other in self.others):
            raise ValueError("others must have no others")
        return self

    @cached_property
    def loop(self) -> Loop:
        """The loop."""
        return parse_stored_loop(self.loop_settings)

    @property
    def logged_covariates(self) -> tuple[str, ...]:
        """Names of the channels that a recording must have beside r, u and y; a warm-up that nobody logs is none."""
        return () if self.covariates is None or self.covariates.warm_up is not None else self.covariates.names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Names of the faults that its plant knows."""
        return tuple(fault.name for fault in self.loop.plant.all_faults)

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the operating points; none where none was declared."""
        return (self.point, *(other.point for other in self.others)) if self.point or self.others else ()

    @property
    def per_point(self) -> tuple[Baseline, ...]:
        """One baseline per operating point; itself where none was declared."""
        return (self.model_copy(update={"others": ()}), *self.others)

    def at(self, point: str | Mapping[str, float]) -> Baseline:
        """Return the baseline of one operating point: its name, or values of the covariates, ``{"temperature": 47.0}``.

        Raises
        ------
        BaselineError
            If there is no such point, or a covariate is missing or outside of what was learned.
        """
        if not isinstance(point, str):
            return self._at_covariates(point)
        for baseline in self.per_point:
            if point and baseline.point == point:
                return baseline
        known = f"choose from {', '.join(self.points)}" if self.points else "the baseline has none"
        raise BaselineError(f"there is no operating point {point!r}: {known}")

    def _at_covariates(self, values: Mapping[str, float]) -> Baseline:
        model = self.covariates
        if model is None or set(values) != set(model.names):
            known = f"give {', '.join(model.names)}" if model is not None else "the baseline has none"
            raise BaselineError(f"there are no covariates {', '.join(values)}: {known}")
        c = np.array([float(values[name]) for name in model.names])
        if (outside := model.describe_outside(c[None])) is not None:
            raise BaselineError(str(outside))
        theta = model.theta(origin := np.array(self.theta), c)
        covariance = self.covariance_array() + model.theta_covariance(origin, c)
        update: dict[str, Any] = {"theta": tuple(theta.tolist()), "covariance": tuple(map(tuple, covariance.tolist()))}
        update |= {"covariates": None, "residual": None}
        update["features"] = None if self.features is None else self.features.at(c)
        moved: dict[str, Any] = {}
        if self.healthy.theta:
            moved["theta"] = tuple((np.array(self.healthy.theta) + theta - origin).tolist())
        if self.healthy.ratios:
            wanted = nominal_theta(self.loop, self.plant) + theta - origin
            moved["ratios"] = match_ratios(self.loop, self.healthy.ratios, wanted, covariance)
        update["healthy"] = self.healthy.model_copy(update=moved)
        if self.axis is not None:
            moves = list(zip(self.names, model.proportional, theta.tolist(), origin.tolist(), strict=True))
            update["axis"] = self.axis.at(
                {name: value / middle for name, proportional, value, middle in moves if proportional},
                {name: value - middle for name, proportional, value, middle in moves if not proportional},
            )
        return self.model_copy(update=update)

    @property
    def plant(self) -> Plant:
        """The plant with its healthy parameters as learned."""
        return self.loop.plant.scaled(self.healthy.ratios) if self.healthy.ratios else self.loop.plant

    @property
    def tuning(self) -> Tuning:
        """What the recursion takes."""
        return self.recursion.at(np.array(self.theta))

    @property
    def extrapolates(self) -> bool:
        """Whether the model holds under a motion that the recordings do not hold.

        So it does where the plant of the loop file explains them down to their noise as it stands. A plant that is not
        linear, or a file that is wrong, asks for further parameters, or leaves no sequential test.
        """
        exact = self.exact is not None and self.exact.misfit <= 1.0
        ratios = self.healthy.ratios
        as_it_stands = set(ratios) <= set(self.loop.plant.parameters)
        # a baseline of nominal parameters has no ratios, and its motion was simulated
        return as_it_stands and (bool(self.thresholds.hypotheses) or (exact and not ratios))

    @property
    def limited_motion(self) -> MotionRange | None:
        """The motion outside of which the model is not known to hold; None where it is, or nothing was stored."""
        return None if self.extrapolates else self.motion

    def pipeline(self) -> Pipeline:
        """Return the loop's chain of constant matrices."""
        return self._pipeline

    @cached_property
    def _pipeline(self) -> Pipeline:
        tuning = self.recursion
        return Pipeline.of(self.loop, tuning.stage_one, tuning.still_speed, tuning.instrument)

    @cached_property
    def fault_directions(self) -> dict[str, FloatArray]:
        """What a relative change of each parameter adds to the healthy coefficients, each of shape (n,)."""
        return fault_directions(self.loop, self.plant, np.array(self.theta))

    @cached_property
    def bias(self) -> FloatArray:
        """What the biases of the regression add to the healthy coefficients, shape (n,)."""
        if not self.healthy.theta or self.loop.monitor.structure != "svf":
            return np.zeros(len(self.theta))
        return np.array(self.healthy.theta) - nominal_theta(self.loop, self.plant)

    def shared(self, assets: int) -> Self:
        """Return the baseline of one among many assets that share its budget of false alarms.

        Each asset gets an equal part: whatever they have in common, all together raise at most the budget's alarms
        (Bonferroni).

        Raises BaselineError if there is not at least one asset.
        """
        if assets < 1:
            raise BaselineError(f"a budget cannot be shared by {assets} assets, give at least 1")
        monitor = self.loop.monitor
        budget = monitor.false_alarms_per_year / assets
        loop = self.loop.model_copy(update={"monitor": monitor.model_copy(update={"false_alarms_per_year": budget})})
        features = self.features.shared(budget) if self.features is not None else None
        known = self.thresholds
        tests = bool(known.hypotheses), features is not None
        limit = t2_threshold(loop, len(self.names), known.dof, known.calibration, *tests)
        thresholds = known.model_copy(update={"statistic": limit})
        others = tuple(other.shared(assets) for other in self.others)
        return self.model_copy(
            update={
                "loop_settings": loop.to_dict(),
                "thresholds": thresholds,
                "features": features,
                "others": others,
            }
        )

    def covariance_array(self) -> FloatArray:
        """Return `covariance` as an array (n, n)."""
        return np.array(self.covariance)

    def covariance_after(self, updates: FloatArray) -> FloatArray:
        """Return `covariance` after so many updates of the recursion, shape (n, n) or (..., n, n): see `transient`."""
        C, transient = self.covariance_array(), self.scatter.transient
        if not transient:
            return C
        settled = np.asarray(updates)[..., None, None] > self.settled_after
        return np.where(settled, C - np.diag(transient), C)

    @property
    def scatter_from(self) -> int:
        """Recordings that its scatter is known from, its own or those of an earlier baseline."""
        return max(len(self.sources), self.scatter.carried_from)

    @property
    def settled_after(self) -> float:
        """Updates after which the recursion has forgotten its start."""
        return SETTLED_MEMORIES * self.pipeline().memory

    def to_frame(self) -> Any:
        """Return the healthy coefficients as a frame of pandas, a row for each with its standard deviation.

        Raises RecordingError if pandas is missing.

        Examples
        --------
        >>> ss.Baseline.load("baseline.json").to_frame()["coefficient"].tolist()
        ['viscous_friction', 'inertia', 'coulomb_friction', 'offset']
        """
        rows = [
            {"point": baseline.point, "coefficient": name, "value": value, "std": std}
            for baseline in self.per_point
            for name, value, std in zip(
                baseline.names, baseline.theta, np.sqrt(np.diag(baseline.covariance_array())).tolist(), strict=True
            )
        ]
        return frame_of("baseline", rows)

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind.

        Raises OutputError if the file cannot be written.
        """
        atomic_write(Path(path), self.to_text().encode())

    def to_text(self) -> str:
        """Return the baseline as JSON, as `save` writes it."""
        content = {"format": FORMAT, "version": VERSION, **self.model_dump(mode="json", by_alias=True)}
        return json.dumps(content, indent=1) + "\n"

    def _shown_facts(self) -> dict[str, object]:
        healthy = ", ".join(f"{name} {value:.4g}" for name, value in zip(self.names, self.theta, strict=True))
        return {"loop": self.loop.name, "recordings": len(self.sources), "healthy": healthy, "hash": self.hash}

    @classmethod
    def of(cls, source: Baseline | str | Path) -> Baseline:
        """Return a baseline as it is, or read it from a path; raises TypeError if it is neither."""
        if isinstance(source, Baseline):
            return source
        if not isinstance(source, str | Path):
            raise TypeError(f"a baseline is a Baseline or the path of one, not {type(source).__name__}")
        return cls.load(source)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a baseline.

        Raises BaselineError if the file is missing, is no baseline, or is one of another version.
        """
        try:
            text = Path(path).read_bytes()
        except FileNotFoundError:
            raise BaselineError(f"{path}: no such file; make a baseline with servoscope learn") from None
        except OSError as error:
            raise BaselineError(f"{path}: cannot be read ({error.strerror or error})") from None
        return cls.parse(text, path)

    @classmethod
    def parse(cls, text: str | bytes, path: str | Path) -> Self:
        """Return the baseline of a text that `to_text` made, or raise BaselineError; `path`: what messages call it."""
        try:
            content = json.loads(text if isinstance(text, str) else text.decode())
        except (ValueError, RecursionError):
            raise BaselineError(
                f"{path}: is not a baseline (no JSON); give the file that servoscope learn wrote"
            ) from None
        if isinstance(content, Mapping) and (other := OTHER_FORMAT.fullmatch(str(content.get("format")))):
            raise BaselineError(
                f"{path}: baseline of kind {other[1]!r}, which is no loop: diagnose, services and fleets take it"
            )
        if not isinstance(content, Mapping) or content.get("format") != FORMAT:
            raise BaselineError(f"{path}: is not a baseline; give the file that servoscope learn wrote")
        version = content.get("version")
        if version not in (FLAT_VERSION, VERSION):
            known = f"{FLAT_VERSION} and {VERSION}"
            raise BaselineError(f"{path}: baseline of version {version!r}, this program reads {known}: learn it again")
        fields = {key: value for key, value in content.items() if key not in ("format", "version")}
        fields = group_flat_fields(fields) if version == FLAT_VERSION else fields
        try:
            baseline = cls.model_validate(fields)
            _ = [point.loop for point in baseline.per_point]
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise BaselineError(f"{path}: damaged baseline, {where}: {first['msg'].lower()}; learn it again") from None
        except LoopError as error:
            raise BaselineError(f"{path}: damaged baseline, {error}; learn it again") from None
        return baseline
