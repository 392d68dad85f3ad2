"""A loop, and healthy recordings if there are any, to the study before deployment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import SimulationError
from servoscope.core.messages import Message, message, text_message
from servoscope.design import dither, frequencies, mimics
from servoscope.design.detection_delay import AlarmSimulator, detectability_radius
from servoscope.design.fisher_information import (
    cosines,
    cramer_rao_std,
    fisher_matrix,
    inverse_information,
    linear_isolability_radius,
)
from servoscope.design.isolability import Span, ambiguous_sizes, hypothesis_distances
from servoscope.design.operating_limits import LIMIT_KINDS, LimitKind, OperatingLimit, operating_limits
from servoscope.design.result import (
    SIZES,
    DesignStudy,
    DetectionDelay,
    DirectionStudy,
    DitherStudy,
    FaultStudy,
    FrequencyComparison,
    FrequencyStudy,
    JointStudy,
    MimicStudy,
    PairStudy,
    SizePrecision,
    Spans,
)
from servoscope.design.scenario import Scenario, require_exact_predictor
from servoscope.detection.statistic import POWER
from servoscope.estimation.noise_model import WhiteNoise
from servoscope.learning.learn import SHORTEST, learn_baseline
from servoscope.models.loop import Loop
from servoscope.models.plants import Fault
from servoscope.signals import Recording
from servoscope.simulation import reference as motion
from servoscope.simulation import simulate
from servoscope.simulation.measurement import NOISE_U_STD, NOISE_Y_STD

LEARNED_S = 60.0  # of a healthy recording that is simulated, at least
BEFORE_S = 60.0  # of healthy motion before the onset
SEED = 1

Progress = Callable[[str], None]


def design_study(
    loop: Loop,
    recordings: Sequence[Recording] = (),
    *,
    reference: str | FloatArray = "profile",
    after_s: float = 30.0,
    noise_u_std: float = NOISE_U_STD,
    noise_y_std: float = NOISE_Y_STD,
    progress: Progress = lambda _: None,
) -> DesignStudy:
    """Compute before deployment which faults of a loop can be detected and isolated, at which size, after how long.

    Parameters
    ----------
    loop
        Loop with a controller and a linear plant whose nominal values are known.
    recordings
        Healthy recordings: the baseline is learned from them, and their noise and the reference of the longest one are
        used. Without any, one is simulated under `reference` with noise as given, and learned from.
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
    require_exact_predictor(loop)
    samples = round((BEFORE_S + after_s) * loop.sample_rate)
    if recordings:
        longest = max(recordings, key=lambda rec: rec.samples)
        progress("learning")
        return study(
            learn_baseline(loop, recordings),
            np.resize(longest.r, max(samples, 1)),
            after_s,
            reference=message("design.reference_of", recording=longest.name),
            progress=progress,
        )
    learned = max(LEARNED_S, SHORTEST * loop.monitor.memory)
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
AMOUNTS = {"relative": 0.01, "samples": 0.1}  # of mimics


def study(
    baseline: Baseline,
    r: FloatArray,
    after_s: float = 30.0,
    *,
    reference: str | Message = "",
    progress: Progress = lambda _: None,
) -> DesignStudy:
    """Compute which faults can be detected and isolated, at which size, after how long, by simulating the loop.

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
        Called with each step: once per fault and direction and three times more.

    Raises
    ------
    BaselineError, LoopError
        If the baseline's loop cannot be simulated, or not by the exact predictor.
    SimulationError
        If r does not fit.
    """
    progress("alarms")
    scene = Scenario.from_baseline(baseline, r, after_s)
    alarms = AlarmSimulator(scene)
    lost = {(one.fault, one.kind): one for one in operating_limits(scene.loop)}
    faults = {f.name: _fault(scene, alarms, f, lost, progress) for f in scene.loop.plant.faults}
    progress("mimics and frequencies")
    columns = scene.project_out_nuisances(scene.sensitivity)
    names = list(faults)
    cosine = cosines(columns, columns)
    mimics_studied = [_mimic(scene, cause) for cause in mimics.mimic_causes(scene)]
    monitored = _frequencies(scene, alarms)
    progress("dither")
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
        joint=_joint(scene),
        pairs=tuple(_pair(scene, names, i, j) for i, j in combinations(range(len(names)), 2)),
        mimics=tuple(mimics_studied),
        frequencies=monitored,
        dither=tuple(_dither(names, each) for each in [dither.without_dither(scene), *dither.best_dither(scene)]),
    )


def _fault(
    scene: Scenario,
    alarms: AlarmSimulator,
    fault: Fault,
    lost: Mapping[tuple[str, LimitKind], OperatingLimit],
    progress: Progress,
) -> FaultStudy:
    i = scene.names.index(fault.parameter)
    sizes = []
    for seconds in sorted({min(s, scene.after_s) for s in SECONDS}):
        exact, learned = (cramer_rao_std(fisher_matrix(scene, seconds, known)) for known in (True, False))
        values = [_finite(each[i]) for each in (*exact, *learned)]
        sizes.append(SizePrecision(seconds=seconds, **dict(zip(STDS, values, strict=True))))
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
        information=float(fisher_matrix(scene)[i, i]) / scene.after_s,
        sizes=tuple(sizes),
        up=sides[0],
        down=sides[1],
    )


STDS = ("alone", "together", "alone_learned", "together_learned")


def _side(scene: Scenario, alarms: AlarmSimulator, fault: Fault, up: bool) -> DirectionStudy:
    sign = 1.0 if up else -1.0
    seen = detectability_radius(alarms, fault, up)
    end = abs(float(np.log(fault.ratio_range[1 if up else 0])))
    delays = [_detection_delay(alarms, fault, sign * seen * k) for k in SIZES if seen * k <= end]
    found = ambiguous_sizes(scene, fault, up)
    first = next((high for _, high in found.spans), 0.0)
    at = min(first, end) or min(seen, end)
    misnamed = hypothesis_distances(scene, fault, sign * seen).misnaming_probabilities() if np.isfinite(seen) else {}
    return DirectionStudy(
        detectable=_ratio(sign * seen),
        delays=tuple(each for each in delays if each is not None),
        unclear=_spans(found.spans, sign),
        certain=_spans(found.spans_if_certain, sign),
        bound=_ratio(sign * linear_isolability_radius(fisher_matrix(scene), scene.names.index(fault.parameter))),
        nearest=_nearest_fault(scene, fault, sign * at),
        called=misnamed,
    )


def _nearest_fault(scene: Scenario, fault: Fault, x: float) -> str:
    try:
        return hypothesis_distances(scene, fault, x).nearest
    except SimulationError:
        return ""


def _detection_delay(alarms: AlarmSimulator, fault: Fault, x: float) -> DetectionDelay | None:
    try:
        delays = alarms.delays(fault, x)
    except SimulationError:  # nobody could have recorded it
        return None
    half, most = (_finite(delays.quantile(share)) for share in (0.5, POWER))
    return DetectionDelay(ratio=float(np.exp(x)), probability=delays.probability(), half_s=half, most_s=most)


def _joint(scene: Scenario) -> JointStudy:
    F = fisher_matrix(scene, exact=False)
    C = inverse_information(F)
    std = np.sqrt(np.diag(C))
    size = np.sqrt(np.maximum(np.diag(F), 1e-300))
    value, vector = np.linalg.eigh(F / np.outer(size, size))
    shares = vector[:, 0] / size
    shares = shares / shares[int(np.argmax(np.abs(shares)))]
    return JointStudy(
        parameters=scene.names,
        std=tuple(_finite(x) for x in cramer_rao_std(F)[1]),
        correlation=tuple(tuple(row) for row in (C / np.outer(std, std)).tolist()),
        confused=dict(zip(scene.names, shares.tolist(), strict=True)),
        worst=float(1.0 / np.sqrt(max(value[0], 1e-12))),
    )


def _pair(scene: Scenario, names: Sequence[str], i: int, j: int) -> PairStudy:
    F = fisher_matrix(scene, exact=False)[np.ix_([i, j], [i, j])]
    C, (one, other) = inverse_information(F), cramer_rao_std(F)[1]
    correlation = float(C[0, 1] / np.sqrt(C[0, 0] * C[1, 1]))
    return PairStudy(names=(names[i], names[j]), std=(_finite(one), _finite(other)), correlation=correlation)


def _mimic(scene: Scenario, cause: mimics.MimicCause) -> MimicStudy:
    found, amount = mimics.match_mimic(scene, cause), AMOUNTS[cause.unit]
    names = [fault.name for fault in scene.loop.plant.faults]
    return MimicStudy(
        name=cause.name,
        words=cause.words,
        amount=amount,
        unit=cause.unit,
        cosines=dict(zip(names, found.cosine.tolist(), strict=True)),
        imitates=names[found.fault],
        looks_like=float(np.exp(amount * found.size)),
        told_apart=_finite(found.distinguishable_from),
    )


def _frequencies(scene: Scenario, alarms: AlarmSimulator) -> FrequencyComparison:
    own = frequencies.frequency_sensitivity(scene, alarms.covariance, np.array(scene.loop.monitor.frequencies))
    best = frequencies.best_frequencies(scene, alarms.covariance)
    gain = best.score(list(range(len(best.frequencies)))) - own.score(list(range(len(own.frequencies))))
    return FrequencyComparison(
        own=_frequency_studies(scene, own), best=_frequency_studies(scene, best), gain=float(np.exp(gain))
    )


def _frequency_studies(scene: Scenario, seen: frequencies.FrequencySensitivity) -> tuple[FrequencyStudy, ...]:
    names = [fault.name for fault in scene.loop.plant.faults]

    def std(row: FloatArray) -> dict[str, float | None]:
        return {name: 1.0 / float(x) if x > 1e-9 else None for name, x in zip(names, row, strict=True)}

    return tuple(
        FrequencyStudy(frequency_hz=float(f), alone=std(alone), apart=std(own))
        for f, alone, own in zip(seen.frequencies, seen.alone, seen.isolated, strict=True)
    )


def _dither(names: Sequence[str], found: dither.DitherEffect) -> DitherStudy:
    return DitherStudy(
        frequency_hz=found.frequency_hz,
        share=found.share,
        amplitude=found.amplitude,
        extra_u_rms=found.extra_u_rms,
        std={name: _finite(x) for name, x in zip(names, found.std, strict=True)},
        radius={name: _ratio(float(x)) for name, x in zip(names, found.radius, strict=True)},
    )


def _spans(spans: Sequence[Span], sign: float) -> Spans:
    return tuple((float(np.exp(sign * low)), _ratio(sign * high)) for low, high in spans)


def _ratio(x: float) -> float | None:
    """Return the ratio of a logarithm; None where there is none, or none that a number can hold."""
    return float(np.exp(x)) if abs(x) < 100.0 else None


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
