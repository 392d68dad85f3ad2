"""A loop, and healthy recordings if there are any, to the study before deployment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, LoopError, SimulationError
from servoscope.core.messages import Message, message, text_message
from servoscope.design.detectability import AlarmPower, detectable_size
from servoscope.design.fisher_information import (
    cosines,
    fisher_matrix,
    linear_isolability_radius,
)
from servoscope.design.isolability import ambiguous_sizes, hypothesis_distances
from servoscope.design.mimics import match_mimic, mimic_causes
from servoscope.design.operating_limits import LIMIT_KINDS, LimitKind, OperatingLimit, operating_limits
from servoscope.design.result import (
    BaselineStudy,
    DesignStudy,
    DirectionStudy,
    FaultPromise,
    FaultStudy,
    SizePrecision,
)
from servoscope.design.scenario import Scenario, require_exact_predictor, require_study
from servoscope.detection.statistic import required_noncentrality
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.isolation.ml.search import BEFORE_S
from servoscope.learning.inspection.rules import MIN_MEMORIES
from servoscope.learning.learn import learn_baseline
from servoscope.models.loop import Loop
from servoscope.models.plants import Fault
from servoscope.signals import Recording
from servoscope.signals.readers import as_recording
from servoscope.signals.readers.frames import Source
from servoscope.simulation import reference as motion
from servoscope.simulation import simulate
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

LEARNED_S = 60.0  # of a healthy recording that is simulated, at least
SEED = 1

Progress = Callable[[str], None]


def design_study(
    loop: Loop | str | Path,
    recordings: Sequence[Recording | Source] = (),
    *,
    reference: str | FloatArray = "profile",
    after_s: float = 30.0,
    noise_u_std: float = NOISE_U_STD,
    noise_y_std: float = NOISE_Y_STD,
    progress: Progress = lambda _: None,
) -> DesignStudy:
    """Compute before deployment which faults of a loop can be detected and isolated, and at which size.

    Parameters
    ----------
    loop
        Loop with a controller and a linear plant whose nominal values are known, or its path.
    recordings
        Healthy recordings, or what `read` reads: the baseline is learned from them, and their noise and the reference
        of the longest one are used. Without any, one is simulated under `reference` with noise as given, and learned
        from.
    reference
        Kind of reference or file, as for `servoscope.simulation.reference`, or the reference itself, shape (N,), which
        is repeated as often as it takes.
    after_s
        Seconds since the onset of a fault that may be used.
    noise_u_std, noise_y_std
        Standard deviations of the noise that enters with u and of the sensor of y; without recordings.
    progress
        Told what is being done.

    Raises
    ------
    LoopError
        If the loop has no controller, no nominal values, or a plant that is not linear.
    BaselineError, NotEnoughError, RecordingError, SimulationError
        If the baseline cannot be learned, or the reference does not fit.
    """
    loop = Loop.of(loop)
    require_exact_predictor(loop)
    samples = round((BEFORE_S + after_s) * loop.sample_rate)
    if recordings:
        healthy = [as_recording(recording, loop) for recording in recordings]
        longest = max(healthy, key=lambda rec: rec.samples)
        progress("learning")
        return study(
            learn_baseline(loop, healthy),
            np.resize(longest.r, max(samples, 1)),
            after_s,
            reference=message("design.reference_of", recording=longest.name),
            progress=progress,
        )
    learned = max(LEARNED_S, MIN_MEMORIES * loop.monitor.memory)
    progress("learning")
    r, reference_name = _reference_motion(loop, reference, max(learned, BEFORE_S + after_s))
    noise = WhiteNoise(noise_u_std, noise_y_std)
    baseline = _learn_simulated(loop, r[: round(learned * loop.sample_rate)], noise)
    return study(baseline, r[: max(samples, 1)], after_s, reference=reference_name, progress=progress)


def _reference_motion(loop: Loop, reference: str | FloatArray, duration_s: float) -> tuple[FloatArray, Message]:
    if isinstance(reference, str):
        return motion(reference, duration_s, loop.sample_rate), text_message(reference)
    return np.resize(reference, round(duration_s * loop.sample_rate)), message("design.reference_given")


def _learn_simulated(loop: Loop, r: FloatArray, noise: WhiteNoise) -> Baseline:
    healthy, _ = simulate(loop, r, noise_u_std=noise.u_std, noise_y_std=noise.y_std, seed=SEED)
    return learn_baseline(loop, [healthy])


SECONDS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # after the onset, as far as they are studied


def study(
    baseline: Baseline,
    r: FloatArray,
    after_s: float = 30.0,
    *,
    reference: str | Message = "",
    progress: Progress = lambda _: None,
) -> DesignStudy:
    """Compute which faults can be detected and isolated, and at which size, by simulating the loop.

    Parameters
    ----------
    baseline
        What healthy looks like.
    r
        Reference at the loop's sample rate, shape (N,); the fault is there in the last `after_s` [s] of it.
    after_s
        Seconds since the onset that may be used.
    reference
        Name of r.
    progress
        Called with each step: once per fault and direction and twice more.

    Raises
    ------
    BaselineError, LoopError
        If the baseline's loop cannot be simulated, or not by the exact predictor.
    SimulationError
        If r does not fit.
    """
    progress("alarms")
    scene = Scenario.from_baseline(baseline, r, after_s)
    alarms = AlarmPower(scene)
    lost = {(limit.fault, limit.kind): limit for limit in operating_limits(scene.loop)}
    faults = {f.name: _fault(scene, alarms, f, lost, progress) for f in scene.loop.plant.faults}
    progress("mimics")
    columns = scene.project_out_nuisances(scene.sensitivity)
    names = list(faults)
    cosine = cosines(columns, columns)
    return DesignStudy(
        loop=scene.loop.name,
        reference=text_message(reference) if isinstance(reference, str) else reference,
        units=scene.loop.plant.units,
        before_s=scene.onset / scene.loop.sample_rate,
        after_s=scene.after_s,
        noise_u_std=scene.noise.u_std,
        noise_y_std=scene.noise.y_std,
        false_alarms_per_year=scene.loop.monitor.false_alarms_per_year,
        faults=faults,
        cosines={name: dict(zip(names, map(float, row), strict=True)) for name, row in zip(names, cosine, strict=True)},
        mimics=tuple(match_mimic(scene, cause) for cause in mimic_causes(scene)),
    )


def _fault(
    scene: Scenario,
    alarms: AlarmPower,
    fault: Fault,
    lost: Mapping[tuple[str, LimitKind], OperatingLimit],
    progress: Progress,
) -> FaultStudy:
    i = scene.names.index(fault.parameter)
    sizes = []
    for seconds in sorted({min(s, scene.after_s) for s in SECONDS}):
        information = float(fisher_matrix(scene, seconds, exact=False)[i, i])
        std = _finite(1.0 / np.sqrt(information)) if information > 0.0 else None  # the Cramer-Rao bound
        sizes.append(SizePrecision(seconds=seconds, std=std))
    sides = []
    for up in (True, False):
        progress(f"{fault.name}, {'up' if up else 'down'}")
        limits: dict[str, float | None] = {
            kind: getattr(lost[fault.name, kind], "up" if up else "down") for kind in LIMIT_KINDS
        }
        sides.append(_side(scene, alarms, fault, up).model_copy(update=limits))
    return FaultStudy(
        name=fault.name,
        parameter=fault.parameter,
        sizes=tuple(sizes),
        up=sides[0],
        down=sides[1],
    )


def _side(scene: Scenario, alarms: AlarmPower, fault: Fault, up: bool) -> DirectionStudy:
    sign = 1.0 if up else -1.0
    seen = detectable_size(alarms, fault, up)
    end = abs(float(np.log(fault.ratio_range[1 if up else 0])))
    spans = ambiguous_sizes(scene, fault, up)
    first = next((high for _, high in spans), 0.0)
    at = min(first, end) or min(seen, end)
    return DirectionStudy(
        detectable=_ratio(sign * seen),
        unclear=tuple((float(np.exp(sign * low)), _ratio(sign * high)) for low, high in spans),
        bound=_ratio(sign * linear_isolability_radius(fisher_matrix(scene), scene.names.index(fault.parameter))),
        nearest=_nearest_fault(scene, fault, sign * at),
    )


def _nearest_fault(scene: Scenario, fault: Fault, x: float) -> str:
    try:
        return hypothesis_distances(scene, fault, x).nearest
    except SimulationError:
        return ""


def _ratio(x: float) -> float | None:
    """Return the ratio of a logarithm; None where there is none, or none that a number can hold."""
    return float(np.exp(x)) if abs(x) < 100.0 else None


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def study_baseline(
    baseline: Baseline,
    *,
    reference: str | FloatArray = "profile",
    after_s: float = 30.0,
    progress: Progress = lambda _: None,
) -> DesignStudy | BaselineStudy:
    """Compute the same from a baseline alone: its healthy plant and noise, under a reference.

    Where its loop cannot be simulated, only what the baseline itself knows is computed, under the motion that it was
    learned from; `missing` says why.
    """
    try:
        require_study(baseline)
    except (BaselineError, LoopError) as error:
        return learned_study(baseline, str(error))
    r, name = _reference_motion(baseline.loop, reference, BEFORE_S + after_s)
    return study(baseline, r, after_s, reference=name, progress=progress)


def learned_study(baseline: Baseline, missing: str) -> BaselineStudy:
    """Compute sizes and likeness of faults from a baseline's promises, and from the covariance of its estimates.

    A fault moves the coefficients by its signature d. With forgetting over N samples white noise gives theta_hat the
    covariance P_d/2, to which the baseline adds its own C, so that two faults are alike by d_i' (P_d/2 + C)^-1 d_j.
    The promises, which know the colour of the noise, say how large each has to be.
    """
    promises = {promise.parameter: promise.change for promise in baseline.detectability.changes}
    names = tuple(fault.name for fault in baseline.loop.plant.faults)
    changes = np.array([promises.get(fault.parameter) or np.inf for fault in baseline.loop.plant.faults])
    signatures = np.array([baseline.fault_directions[fault.parameter] for fault in baseline.loop.plant.faults])
    root = np.linalg.cholesky(np.linalg.inv(np.array(baseline.recursion.P_d) / 2.0 + baseline.covariance_array()))
    cosine = cosines(root.T @ signatures.T, root.T @ signatures.T)
    sensitivity = np.sqrt(required_noncentrality(len(baseline.theta), baseline.thresholds.statistic)) / changes
    F = cosine * np.outer(sensitivity, sensitivity)
    alike = np.abs(cosine) - 2.0 * np.eye(len(names))
    faults = {
        fault.name: FaultPromise(
            parameter=fault.parameter,
            detectable=_finite(changes[i]),
            isolable=_finite(linear_isolability_radius(F, i)) if len(names) > 1 else _finite(changes[i]),
            nearest=names[int(np.argmax(alike[i]))] if len(names) > 1 else "",
        )
        for i, fault in enumerate(baseline.loop.plant.faults)
    }
    return BaselineStudy(
        loop=baseline.loop.name,
        missing=missing,
        false_alarms_per_year=baseline.loop.monitor.false_alarms_per_year,
        faults=faults,
        cosines={name: dict(zip(names, map(float, row), strict=True)) for name, row in zip(names, cosine, strict=True)},
    )
