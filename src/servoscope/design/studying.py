"""A baseline and a reference to what can be detected and told apart: all of the study, put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

from servoscope.baseline import Baseline
from servoscope.design import dither, frequencies, mimics
from servoscope.design.alarms import Alarms, detectable
from servoscope.design.distances import Span, apart, unclear
from servoscope.design.findings import (
    SIZES,
    Announced,
    Dither,
    FaultStudy,
    Frequencies,
    Frequency,
    Joint,
    Mimic,
    PairStudy,
    Side,
    Sized,
    Spans,
    Study,
)
from servoscope.design.information import bound, cosines, covariance, deviations, fisher
from servoscope.design.scene import Scene
from servoscope.detection import POWER
from servoscope.errors import SimulationError
from servoscope.plants import Fault, FloatArray

Progress = Callable[[str], None]

SECONDS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # after the onset, as far as they are studied
AMOUNTS = {"relative": 0.01, "samples": 0.1}  # of mimics


def study(
    baseline: Baseline,
    r: FloatArray,
    after_s: float = 30.0,
    *,
    reference: str = "",
    progress: Progress = lambda _: None,
) -> Study:
    """Say which faults can be detected and told apart, at which size, after how long.

    Nothing is measured: the loop of the baseline is simulated under the reference, with its noise.

    Parameters
    ----------
    baseline
        What healthy looks like.
    r
        Reference of a recording at the loop's sample rate, shape (N,). The last `after_s` [s] are those with a fault,
        what is before them is healthy.
    after_s
        Seconds since the onset that may be used.
    reference
        What r is called.
    progress
        Told what is being done, once per fault and direction and three times more.

    Raises
    ------
    BaselineError, LoopError
        If the baseline's loop cannot be simulated, or not by the exact predictor.
    SimulationError
        If r does not fit.
    """
    progress("alarms")
    scene = Scene.of(baseline, r, after_s)
    alarms = Alarms(scene)
    faults = {f.name: _fault(scene, alarms, f, progress) for f in scene.loop.plant.faults}
    progress("mimics and frequencies")
    columns = scene.projected(scene.sensitivity)
    names = list(faults)
    cosine = cosines(columns, columns)
    told = [_mimic(scene, cause) for cause in mimics.causes(scene)]
    monitored = _frequencies(scene, alarms)
    progress("dither")
    return Study(
        loop=scene.loop.name,
        reference=reference,
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
        mimics=tuple(told),
        frequencies=monitored,
        dither=tuple(_dither(names, each) for each in [dither.without(scene), *dither.best(scene)]),
    )


def _fault(scene: Scene, alarms: Alarms, fault: Fault, progress: Progress) -> FaultStudy:
    i = scene.names.index(fault.parameter)
    sizes = []
    for seconds in sorted({min(s, scene.after_s) for s in SECONDS}):
        exact, learned = (deviations(fisher(scene, seconds, known)) for known in (True, False))
        values = [_finite(each[i]) for each in (*exact, *learned)]
        sizes.append(Sized(seconds=seconds, **dict(zip(STDS, values, strict=True))))
    sides = []
    for up in (True, False):
        progress(f"{fault.name}, {'up' if up else 'down'}")
        sides.append(_side(scene, alarms, fault, up))
    return FaultStudy(
        name=fault.name,
        parameter=fault.parameter,
        information=float(fisher(scene)[i, i]) / scene.after_s,
        sizes=tuple(sizes),
        up=sides[0],
        down=sides[1],
    )


STDS = ("alone", "together", "alone_learned", "together_learned")


def _side(scene: Scene, alarms: Alarms, fault: Fault, up: bool) -> Side:
    sign = 1.0 if up else -1.0
    seen = detectable(alarms, fault, up)
    end = abs(float(np.log(fault.ratio_range[1 if up else 0])))
    delays = [_announced(alarms, fault, sign * seen * k) for k in SIZES if seen * k <= end]
    found = unclear(scene, fault, up)
    first = next((high for _, high in found.spans), 0.0)
    at = min(first, end) or min(seen, end)
    called = apart(scene, fault, sign * seen).called() if np.isfinite(seen) else {}
    return Side(
        detectable=_ratio(sign * seen),
        delays=tuple(each for each in delays if each is not None),
        unclear=_spans(found.spans, sign),
        certain=_spans(found.certain, sign),
        bound=_ratio(sign * bound(fisher(scene), scene.names.index(fault.parameter))),
        nearest=_nearest(scene, fault, sign * at),
        called=called,
    )


def _nearest(scene: Scene, fault: Fault, x: float) -> str:
    try:
        return apart(scene, fault, x).nearest
    except SimulationError:
        return ""


def _announced(alarms: Alarms, fault: Fault, x: float) -> Announced | None:
    try:
        delays = alarms.delays(fault, x)
    except SimulationError:  # nobody could have recorded it
        return None
    half, most = (_finite(delays.quantile(share)) for share in (0.5, POWER))
    return Announced(ratio=float(np.exp(x)), probability=delays.probability(), half_s=half, most_s=most)


def _joint(scene: Scene) -> Joint:
    F = fisher(scene, exact=False)
    C = covariance(F)
    std = np.sqrt(np.diag(C))
    size = np.sqrt(np.maximum(np.diag(F), 1e-300))
    value, vector = np.linalg.eigh(F / np.outer(size, size))
    shares = vector[:, 0] / size
    shares = shares / shares[int(np.argmax(np.abs(shares)))]
    return Joint(
        parameters=scene.names,
        std=tuple(_finite(x) for x in deviations(F)[1]),
        correlation=tuple(tuple(row) for row in (C / np.outer(std, std)).tolist()),
        confused=dict(zip(scene.names, shares.tolist(), strict=True)),
        worst=float(1.0 / np.sqrt(max(value[0], 1e-12))),
    )


def _pair(scene: Scene, names: Sequence[str], i: int, j: int) -> PairStudy:
    F = fisher(scene, exact=False)[np.ix_([i, j], [i, j])]
    C, (one, other) = covariance(F), deviations(F)[1]
    correlation = float(C[0, 1] / np.sqrt(C[0, 0] * C[1, 1]))
    return PairStudy(names=(names[i], names[j]), std=(_finite(one), _finite(other)), correlation=correlation)


def _mimic(scene: Scene, cause: mimics.Cause) -> Mimic:
    found, amount = mimics.imitation(scene, cause), AMOUNTS[cause.unit]
    names = [fault.name for fault in scene.loop.plant.faults]
    return Mimic(
        name=cause.name,
        words=cause.words,
        amount=amount,
        unit=cause.unit,
        cosines=dict(zip(names, found.cosine.tolist(), strict=True)),
        imitates=names[found.fault],
        looks_like=float(np.exp(amount * found.size)),
        told_apart=_finite(found.told_apart),
    )


def _frequencies(scene: Scene, alarms: Alarms) -> Frequencies:
    own = frequencies.seen(scene, alarms.covariance, np.array(scene.loop.monitor.frequencies))
    best = frequencies.best(scene, alarms.covariance)
    gain = best.score(list(range(len(best.frequencies)))) - own.score(list(range(len(own.frequencies))))
    return Frequencies(own=_each(scene, own), best=_each(scene, best), gain=float(np.exp(gain)))


def _each(scene: Scene, seen: frequencies.Seen) -> tuple[Frequency, ...]:
    names = [fault.name for fault in scene.loop.plant.faults]

    def std(row: FloatArray) -> dict[str, float | None]:
        return {name: 1.0 / float(x) if x > 1e-9 else None for name, x in zip(names, row, strict=True)}

    return tuple(
        Frequency(frequency_hz=float(f), alone=std(alone), apart=std(own))
        for f, alone, own in zip(seen.frequencies, seen.alone, seen.apart, strict=True)
    )


def _dither(names: Sequence[str], found: dither.Dithered) -> Dither:
    return Dither(
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
