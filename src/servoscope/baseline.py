"""What healthy looks like: learned from recordings or computed from nominal parameters; one JSON file, versioned."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from servoscope.errors import BaselineError, LoopError
from servoscope.inverse import nominal_theta
from servoscope.labelled import LearnedFault
from servoscope.loop import Loop
from servoscope.noise import Coloured, Noise
from servoscope.output import atomic_write
from servoscope.pipeline import Pipeline, Tuning
from servoscope.plants import FloatArray, Plant
from servoscope.rehearsal import SEQUENTIAL, Rehearsed, limit_of
from servoscope.sequential import Member, rated, watch
from servoscope.signatures import Expectation
from servoscope.twostage import StageOne

if TYPE_CHECKING:
    from servoscope.cusum import Watch

FORMAT = "servoscope-baseline"
VERSION = 2

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Source(_Part):
    """A recording that the baseline was learned from."""

    name: str
    samples: int
    duration_s: float


class Promise(_Part):
    """The smallest change that the baseline promises to see, relative: 0.05 is 5 %; None: none at all."""

    name: str
    parameter: str
    change: float | None


class Exact(_Part):
    """What the exact predictor, of which the refit makes use, says of the healthy recordings.

    Parameters
    ----------
    noise
        n_u and n_y that make their innovations likeliest.
    misfit
        What it leaves unexplained in the worst of them, over what noise leaves in all but one of a thousand: the refit
        is made where this is at most 1.
    """

    noise: Noise
    misfit: float


class Baseline(_Part):
    """What a healthy loop looks like to the monitor; everything that `diagnose` needs.

    Parameters
    ----------
    loop
        The loop, as in its file.
    sources, hash
        What it was learned from.
    names
        Of the n coefficients.
    theta, covariance
        Healthy coefficients (n,) and the covariance of a further healthy recording's mean around them (n, n): noise
        of the baseline, scatter between recordings and model error.
    scale, P_d, R, noise_a, noise_b, noise_gamma, noise_variance
        The recursion's tuning (see `servoscope.pipeline.Tuning`).
    stage_one
        Stage 1 of a loop with two stages.
    noise
        n_u and n_y; None without a controller or physics.
    ratios, ratios_std, ratios_covariance
        Healthy parameters relative to the loop file's nominal values, the standard deviations of their logarithms, and
        their covariance (m, m); empty without a controller or physics.
    model_theta
        Coefficients that those lead to under the references of the baseline; empty likewise.
    dof
        Effective number of independent residuals.
    limit
        Threshold of T^2.
    explained
        Share of eta's variance that the model explains.
    still_speed
        Speed below which the axis stands still [output per s]; 0 where rest is part of what is expected.
    delay_s
        Delay that the recordings show [s]; None where they do not tell.
    loudest
        What the noises may be at most, as far as the recordings tell; None where white noises on u and y do not
        explain the colour of the residual.
    rehearsed
        False alarms that were counted against those of theory.
    members
        Changes that the sequential test listens for; empty where there is none.
    promises
        Smallest changes that are seen with 90 % probability within the baseline's own excitation.
    exact
        What the exact predictor says of the healthy recordings; None where there is none.
    notes
        What `learn` found worth saying.
    learned
        Faults known from labelled recordings; empty where none were given.
    point, others
        Name of the operating point, empty where none was declared; the baselines of the other points. A baseline with
        others is itself that of the first point.
    """

    loop_settings: dict[str, Any] = Field(alias="loop")
    sources: tuple[Source, ...]
    hash: str
    names: tuple[str, ...]
    theta: Vector
    covariance: Matrix
    scale: Vector
    P_d: Matrix
    R: float
    noise_a: Vector
    noise_b: Vector
    noise_gamma: Vector
    noise_variance: float
    stage_one: StageOne | None = None
    noise: Noise | None
    ratios: dict[str, float]
    ratios_std: dict[str, float]
    ratios_covariance: Matrix
    model_theta: Vector
    dof: float
    limit: float
    explained: float
    still_speed: float
    delay_s: float | None
    suggested_model_error: float
    supported_false_alarms_per_year: float
    loudest: Noise | None
    rehearsed: Rehearsed
    members: tuple[Member, ...]
    promises: tuple[Promise, ...]
    notes: tuple[str, ...]
    exact: Exact | None = None
    learned: tuple[LearnedFault, ...] = ()
    point: str = ""
    others: tuple[Baseline, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n, p = len(self.names), len(self.noise_a)
        for name in ("theta", "scale"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"{name} must have {n} values, one per coefficient")
        for name in ("covariance", "P_d"):
            rows = getattr(self, name)
            if len(rows) != n or any(len(row) != n for row in rows):
                raise ValueError(f"{name} must be {n} by {n}")
        if len(self.noise_gamma) != p or not p or not (self.noise_gamma[0] > 0.0 and self.noise_variance > 0.0):
            raise ValueError("noise_a and noise_gamma must have the same length, and a positive variance")
        if len(self.model_theta) not in (0, n):
            raise ValueError(f"model_theta must be empty or have {n} values")
        if not (n and self.R > 0.0 and self.limit > 0.0 and min(self.scale) > 0.0):
            raise ValueError("names, R, limit and scale must be positive")
        C, size = np.array(self.covariance), np.sqrt(np.abs(np.diag(self.covariance)))
        scaled = C / np.outer(size, size) if size.all() else C
        if not np.allclose(scaled, scaled.T, atol=1e-6) or np.linalg.eigvalsh((scaled + scaled.T) / 2.0)[0] < -1e-9:
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
        return Loop.from_dict(self.loop_settings)

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the operating points; none where none was declared."""
        return (self.point, *(other.point for other in self.others)) if self.point or self.others else ()

    @property
    def each(self) -> tuple[Baseline, ...]:
        """One baseline per operating point; itself where none was declared."""
        return (self.model_copy(update={"others": ()}), *self.others)

    def at(self, point: str) -> Baseline:
        """Return the baseline of one operating point.

        Raises
        ------
        BaselineError
            If there is no such point.
        """
        for one in self.each:
            if point and one.point == point:
                return one
        known = f"choose from {', '.join(self.points)}" if self.points else "the baseline has none"
        raise BaselineError(f"there is no operating point {point!r}: {known}")

    @property
    def plant(self) -> Plant:
        """The plant with its healthy parameters as learned."""
        return self.loop.plant.with_ratios(self.ratios) if self.ratios else self.loop.plant

    @property
    def tuning(self) -> Tuning:
        """What the recursion takes."""
        arrays = (self.theta, self.scale, self.P_d)
        theta, scale, P_d = (np.array(value) for value in arrays)
        a, b, gamma = (np.array(value) for value in (self.noise_a, self.noise_b, self.noise_gamma))
        return Tuning(theta, scale, P_d, self.R, Coloured(a, b, gamma, self.noise_variance))

    def pipeline(self) -> Pipeline:
        """Return the loop's chain of constant matrices."""
        return Pipeline.of(self.loop, self.stage_one, self.still_speed)

    def watch(self, pipeline: Pipeline, under: Expectation | None = None, growth: float = 1.0) -> Watch | None:
        """Return the sequential test beside a pipeline's recursion.

        `under` is the expectation of a recording, to whose reference the limits are then fitted, instead of that of
        the baseline; `growth` is that of the noise's variance.
        """
        if self.loudest is None or not self.members:
            return None
        noise = self.loudest.times(np.sqrt(growth))
        budget = SEQUENTIAL * self.loop.monitor.false_alarms_per_year / self.rehearsed.cusum
        heard = self.members
        if under is not None:
            heard = rated(under, self.plant, self.loudest, np.array(self.ratios_covariance), heard)
        return watch(pipeline, self.plant, noise, np.array(self.scale), heard, budget)

    @cached_property
    def bias(self) -> FloatArray:
        """What the biases of the regression add to the healthy coefficients, shape (n,)."""
        if not self.model_theta or self.loop.monitor.structure != "svf":
            return np.zeros(len(self.theta))
        return np.array(self.model_theta) - nominal_theta(self.loop, self.plant)

    def shared(self, assets: int) -> Self:
        """Return the baseline of one among many assets that share its budget of false alarms.

        Each asset gets an equal part: whatever they have in common, all together raise at most the budget's alarms
        (Bonferroni).

        Raises
        ------
        BaselineError
            If there is not at least one asset.
        """
        if assets < 1:
            raise BaselineError(f"a budget cannot be shared by {assets} assets, give at least 1")
        monitor = self.loop.monitor
        budget = monitor.false_alarms_per_year / assets
        loop = self.loop.model_copy(update={"monitor": monitor.model_copy(update={"false_alarms_per_year": budget})})
        limit = limit_of(loop, len(self.names), self.dof, self.rehearsed, bool(self.members))
        others = tuple(other.shared(assets) for other in self.others)
        changed = self.model_copy(update={"loop_settings": loop.to_dict(), "limit": limit, "others": others})
        vars(changed).pop("loop", None)  # a copy takes along what was computed from the old settings
        return changed

    def cov(self) -> FloatArray:
        """Return `covariance` as an array (n, n)."""
        return np.array(self.covariance)

    def save(self, path: str | Path) -> None:
        """Write the baseline as JSON; nothing half-written stays behind.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        content = {"format": FORMAT, "version": VERSION, **self.model_dump(mode="json", by_alias=True)}
        atomic_write(Path(path), (json.dumps(content, indent=1) + "\n").encode())

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a baseline.

        Raises
        ------
        BaselineError
            If the file is missing, is no baseline, or is one of another version.
        """
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise BaselineError(f"{path}: no such file; make a baseline with servoscope learn") from None
        except OSError as error:
            raise BaselineError(f"{path}: cannot be read ({error.strerror or error})") from None
        except (ValueError, RecursionError):
            raise BaselineError(
                f"{path}: is not a baseline (no JSON); give the file that servoscope learn wrote"
            ) from None
        if not isinstance(content, Mapping) or content.get("format") != FORMAT:
            raise BaselineError(f"{path}: is not a baseline; give the file that servoscope learn wrote")
        if content.get("version") != VERSION:
            raise BaselineError(
                f"{path}: baseline of version {content.get('version')!r}, this program reads {VERSION}: learn it again"
            )
        fields = {key: value for key, value in content.items() if key not in ("format", "version")}
        try:
            baseline = cls.model_validate(fields)
            _ = [one.loop for one in baseline.each]
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise BaselineError(f"{path}: damaged baseline, {where}: {first['msg'].lower()}; learn it again") from None
        except LoopError as error:
            raise BaselineError(f"{path}: damaged baseline, {error}; learn it again") from None
        return baseline


def digest(loop: Loop, arrays: list[FloatArray]) -> str:
    """Return a hash of a loop and of all samples that were learned from: 16 hexadecimal digits."""
    h = hashlib.sha256(loop.hash().encode())
    for array in arrays:
        h.update(np.ascontiguousarray(array).tobytes())
    return h.hexdigest()[:16]
