"""What an exported monitor is made of: the sizes and constants of one baseline, or the reason why it has none."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from servoscope import __version__
from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError
from servoscope.detection.covariate_monitor import CovariateMonitor
from servoscope.diagnosis.monitor_constants import MonitorConstants
from servoscope.estimation.frequency_response import FrequencyResponse
from servoscope.estimation.kernel.sample_steps import ARMED, SAMPLE
from servoscope.estimation.kernel.spec import KernelSpec
from servoscope.estimation.recursion import Recursion
from servoscope.export.image import fingerprint
from servoscope.export.texts import plain_text


@dataclass(frozen=True, eq=False)
class ExportConstants:
    """Sizes and constants of one baseline's monitor, for generators of source text."""

    baseline: Baseline
    recursion: Recursion
    spec: KernelSpec
    table: FloatArray  # the constants, in the order of `spec.at`
    start: FloatArray  # the state before the first sample
    healthy: FrequencyResponse
    members: int  # CUSUMs
    delays: tuple[int, int]  # of the alarm, in evaluations
    mark: bytes  # of the baseline, in images
    covariates: CovariateMonitor | None
    expected: FloatArray  # healthy coefficients without the regression's bias, (n,)
    input_stage: str  # what the caller has to do to u beforehand; empty: nothing

    @classmethod
    def from_baseline(
        cls, baseline: Baseline, only_coefficients: bool = False, single: bool = False
    ) -> ExportConstants:
        """Derive the constants of a baseline.

        With `only_coefficients`, what stands before the estimator and behind T^2 is left out: the stages that u goes
        through, and the sequential test; with `single`, numbers are floats.

        Raises
        ------
        BaselineError
            If the baseline has something that cannot be exported; the message names it.
        """
        loop = baseline.loop
        if baseline.others:
            raise BaselineError(
                f"an exported monitor follows one operating point, this baseline has {', '.join(baseline.points)}: "
                f"give --point {baseline.points[0]}"
            )
        if baseline.covariates is not None and baseline.covariates.warm_up is not None:
            raise BaselineError(
                f"{loop.name}: a warm-up that is not logged cannot be exported: learn a baseline with "
                "[monitor] hidden_warm_up = false"
            )
        stage = _input_stage(baseline)
        if stage and not only_coefficients:
            raise BaselineError(
                f"{loop.name}: {stage} cannot be exported: learn a baseline without it, or give "
                "--only-coefficients and hand u over as it is behind that stage"
            )
        if baseline.features is not None and not only_coefficients:
            raise BaselineError(
                f"{loop.name}: features cannot be exported: learn a baseline with "
                "[monitor] feature_false_alarms = 0, or give --only-coefficients"
            )
        if baseline.pressures is not None and not only_coefficients:
            raise BaselineError(
                f"{loop.name}: logged pressures cannot be exported: give --only-coefficients for T^2 alone"
            )
        derived = MonitorConstants.from_baseline(baseline)
        if only_coefficients:
            derived = replace(derived, constants=derived.constants._replace(watch=None))
        covariates = derived.side.covariates
        if single and covariates is not None:
            raise BaselineError(
                f"{loop.name}: a baseline with covariates cannot be exported in single precision: take double"
            )
        if single and not derived.constants.steady:
            raise BaselineError(
                f"[monitor] estimator = {loop.monitor.estimator!r} cannot be exported in single precision: take "
                "akf, or double precision"
            )
        recursion = Recursion([derived.constants], single=single)
        table, start = recursion._table[0], recursion.start()[0]
        structure = repr(recursion._spec) + "single" * single
        if covariates is not None:
            start = np.concatenate([start, covariates.start()])
            structure += covariates.model.model_dump_json()
        on, off = derived.pipeline.delays
        watch = derived.constants.watch
        return cls(
            baseline=baseline,
            recursion=recursion,
            spec=recursion._spec,
            table=table,
            start=start,
            healthy=derived.healthy,
            members=0 if watch is None else len(watch.limits),
            delays=(on, off),
            mark=fingerprint(
                structure,
                table,
                start,
                (baseline.thresholds.statistic, float(on), float(off)),
            ),
            covariates=covariates,
            expected=derived.expected_theta,
            input_stage=stage,
        )


def common_words(made: ExportConstants, name: str) -> dict[str, Any]:
    """Return what the templates of all languages name."""
    baseline, c, plant = made.baseline, made.recursion.constants[0], made.baseline.loop.plant
    of_y, of_u = plant.units[0] or "y", plant.units[1] or "u"
    coefficients = "; ".join(
        f"{coefficient} [{unit}]" for coefficient, unit in zip(baseline.names, plant.coefficient_units, strict=True)
    )
    return {
        "made": made,
        "size": made.spec.sizes,
        "version": __version__,
        "hash": baseline.hash,
        "loop": plain_text(baseline.loop.name),
        "prefix": name,
        "upper": name.upper(),
        "units": plain_text(coefficients),
        "u_unit": plain_text(f"{of_u}, behind the stage {made.input_stage}" if made.input_stage else of_u),
        "y_unit": plain_text(of_y),
        "response_unit": plain_text(f"{of_u}/{of_y}"),
        "stride": c.stride,
        "every": c.every,
        "on_delay": made.delays[0],
        "off_delay": made.delays[1],
        "mark": [f"0x{byte:02X}u" for byte in made.mark],
        "sample": SAMPLE,
        "armed": ARMED,
    }


def covariate_tables(made: ExportConstants) -> dict[str, FloatArray]:
    """Return the constants that a monitor with covariates has beside those of its recursion, by name."""
    if made.covariates is None:
        return {}
    model, c = made.covariates.model, made.recursion.constants[0]
    half = 0.5 * (np.array(model.high) - np.array(model.low))
    E = made.baseline.pipeline().bank.E(made.baseline.loop.monitor.frequencies)
    return {
        "known_range": np.column_stack(model.known),
        "learned": np.column_stack([model.origin, half]),
        "slopes": np.array(model.slopes),
        "slope_covariance": np.array(model.covariance),
        "to_state": np.linalg.inv(c.basis),
        "to_response": np.stack([E.real, E.imag], axis=1).reshape(-1, len(made.expected)),
        "theta_middle": np.array(made.baseline.theta),
        "theta_expected": made.expected,
        "theta_origin": c.origin,
    }


def _input_stage(baseline: Baseline) -> str:
    """Return the setting by which u goes through a stage of its own before the filters, empty if none does."""
    loop = baseline.loop
    if loop.monitor.two_stage != "none":
        return f"[monitor] two_stage = {loop.monitor.two_stage!r}"
    if loop.plant.retraction_gain != 1.0:
        return "[plant] A_b"
    return "[plant] valve_law = 'square-root'" if loop.plant.load_pressure else ""


def refuse_covariates(baseline: Baseline, what: str) -> None:
    """Raise BaselineError if a baseline has covariates, which C alone takes; `what` cannot."""
    if baseline.covariates is not None:
        raise BaselineError(
            f"{baseline.loop.name}: a {what} takes r, u and y alone, this baseline has "
            f"{', '.join(baseline.covariates.names)}: export C, or baseline.at(...) their values"
        )


def check_name(name: str) -> None:
    """Raise BaselineError if a name cannot begin the names of a source text."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", name):
        raise BaselineError(
            f"{name!r} is no prefix for names of C: give lower-case letters, digits and _, as in axis_3"
        )
