"""Signals that are not what the loop file says: stuck, wrapped, exchanged, of the other sign or in another unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from servoscope.core import outofcore
from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.messages import Message, message
from servoscope.estimation.pipeline import Pipeline
from servoscope.evidence.examination import Examination
from servoscope.evidence.kind import EvidenceKind, Finding
from servoscope.signals import Recording
from servoscope.signals.quality import QualityFinding, QualitySettings, check_block, init_state

SIGNALS = ("r", "u", "y")
# units that are confused: powers of ten; inches and mm; degrees and radians; turns and radians; per minute and second
_RATIOS = (*(10.0**k for k in range(1, 7)), 25.4, 180.0 / np.pi, 2.0 * np.pi, 60.0)
FACTORS = (*_RATIOS, *(1.0 / ratio for ratio in _RATIOS))
MIN_RESIDUAL_RATIO = 5.0  # times smaller is the residual of the healthy plant where the signals are put right
MIN_BELIEVED_RATIO = 10.0  # the same where the plant has a fault beside
QUIETEST_SHARE = 0.01  # of the healthy residual, below which no signals that were put right leave
# the same where that residual is the healthy one, and up to how many times that it counts as such
HEALTHY_RESIDUAL_RATIO = 2.0
FROZEN_S = 1.0  # how long y or u stays exactly the same while the motion demands a change [s],
MIN_FROZEN_SAMPLES = 10  # or, where that is longer, so many samples: a loop of 0.1 Hz answers a step after one or two
TRAVEL_SHARE = 0.1  # of the range of y, that r moves by then
FORCE_SHARE = 0.3  # of the range of u, that static friction may hold
UNASKED_SHARE = 0.5  # of a motion, that r - y moves too where y does not follow r
SILENCE_SHARE = 1e-6  # of the largest u: what a resampling filter leaves of 0
JUMP_SHARE = 0.4  # of the range of y, in one sample: a counter that wraps or is reset
MAX_JUMP_SHARE = 0.1  # share of the samples
MIN_STEP_RATIO = 2.0  # times smaller are all other steps of y, and those of r at that time
LEAD_S = 0.2  # beyond the delay from u to y that r may step before y does: drives on a bus answer 0.06 s late [s],
MIN_LEAD_SAMPLES = 3  # or, where that is longer, so many samples
MAX_MEMORIES = 100.0  # of the estimator, from the beginning, that the residual is computed from: minutes
MAX_ROWS = 1_000_000  # of them, for the memory that they take
BEGINNING_SHARE = 0.25  # of the rows in motion: what a log has wrong, a unit or a sign, it has wrong there too
MIN_WRONG_SHARE, MAX_RIGHT_SHARE = (
    0.1,
    0.05,
)  # share of eta^2 that a plant known roughly leaves of signals: wrong, right
UNIT_ERROR = 0.25  # relative, up to which the spreads of r and y tell the factor between their units


@dataclass(frozen=True)
class SignalDefect:
    """What is wrong with a signal, and from which sample on."""

    begin: int  # sample
    description: Message


@dataclass(frozen=True)
class Correction:
    """Which columns are taken as r, u and y, and what each is multiplied by."""

    order: tuple[int, int, int] = (0, 1, 2)
    factors: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def apply(self, recording: Recording) -> Recording:
        """Return the recording with its signals put right."""
        columns = (recording.r, recording.u, recording.y)
        r, u, y = (columns[i] * factor for i, factor in zip(self.order, self.factors, strict=True))
        return replace(recording, r=r, u=u, y=y)

    @property
    def description(self) -> Message:
        """What it says of the signals."""
        moved = tuple(name for i, name in enumerate(SIGNALS) if self.order[i] != i)
        if moved:
            return message("signals.exchanged", names=moved)
        scaled = tuple(name for name, factor in zip(SIGNALS, self.factors, strict=True) if factor != 1.0)
        factor = next(factor for factor in self.factors if factor != 1.0)
        if factor == -1.0:
            return message("signals.sign" if len(scaled) == 1 else "signals.signs", names=scaled)
        return message("signals.unit" if len(scaled) == 1 else "signals.units", names=scaled, factor=factor)


def find_signal_defect(recording: Recording, delay_s: float = 0.0) -> SignalDefect | None:
    """Return the first place where y or u is stuck while the motion demands a change, or where y jumps.

    `delay_s`: from u to y, by which a step of y that r asks for comes later.
    """
    span = float(np.ptp(outofcore.extremes(recording.y)))
    rate, frozen = recording.sample_rate, _frozen_samples(recording)
    settings = QualitySettings(frozen_s=frozen / rate, frozen_travel=TRAVEL_SHARE * span or None)
    limits, state = settings.limits(rate), init_state()
    lead = max(MIN_LEAD_SAMPLES, round(LEAD_S * rate)) + round(delay_s * rate)
    late = frozen + round(delay_s * rate)
    for chunk in outofcore.iter_chunks(0, recording.samples):
        rows = recording.rows(chunk)
        state, findings = check_block(limits, state, rows.t, rows.r, rows.u, rows.y)
        candidates = [_frozen_defect(recording, finding, late) for finding in findings]
        candidates.append(_find_jump(rows, chunk.start, lead))
        outofcore.release(*recording.columns)
        if defects := [defect for defect in candidates if defect is not None]:
            return min(defects, key=lambda defect: defect.begin)
    return None


def find_switched_off(recording: Recording) -> SignalDefect | None:
    """Return from where on the drive is off: u stays at 0 for long while y moves, and not as r asks it to."""
    u, span = recording.u, float(np.ptp(outofcore.extremes(recording.y)))
    silent = SILENCE_SHARE * float(np.abs(outofcore.extremes(u)).max())
    switches, was_off = list[IntArray](), False
    for rows in outofcore.iter_chunks(0, recording.samples, *recording.columns):
        off = (np.abs(u[rows]) <= silent) & ~recording.restart[rows]
        switches.append(rows.start + np.flatnonzero(np.diff(off, prepend=was_off)))
        was_off = bool(off[-1])
    edges = np.concatenate([*switches, np.full(int(was_off), recording.samples)]).reshape(-1, 2)
    for begin, end in edges[np.diff(edges)[:, 0] > _frozen_samples(recording)].tolist():
        y, e = recording.y[begin:end], recording.r[begin:end] - recording.y[begin:end]
        moved = float(np.ptp(y))
        if moved > TRAVEL_SHARE * span and np.ptp(e) > UNASKED_SHARE * moved:
            text = message("signals.off", name=recording.name, t=float(recording.t[begin]), by=moved)
            return SignalDefect(begin, text)
    return None


def find_corrections(
    pipeline: Pipeline, theta: FloatArray, residual_power: float | None, recording: Recording
) -> Iterator[Correction]:
    """Yield corrections of the signals under which the plant with theta explains the recording, the likeliest first.

    `residual_power`: what the plant leaves of eta^2 when healthy; it tells u in another unit from y in another unit,
    which are alike to a linear plant. None yields both. In a tight loop r and y are nearly alike, and exchanging them
    makes the residual few times smaller: where it comes down to the healthy one, that is enough.
    """
    rows = _beginning(pipeline, recording)

    def residual(correction: Correction) -> tuple[float, float]:
        return _residual_share(pipeline, theta, correction.apply(rows))

    share, _ = residual(Correction())
    exchanged = Correction(order=(2, 1, 0))  # a load makes y lag r more, and r is then explained better than y
    single = (correction for correction in _single_corrections() if correction != exchanged or not _lags(rows))
    tried = {correction: residual(correction) for correction in single}
    best, left = min(tried.values(), default=(np.inf, np.inf))
    explained = residual_power is not None and left < HEALTHY_RESIDUAL_RATIO * residual_power
    if not best * (HEALTHY_RESIDUAL_RATIO if explained else MIN_RESIDUAL_RATIO) < share:
        yield from _reference_corrections(rows)
        return
    near = [correction for correction, (power, _) in tried.items() if power < 2.5 * best]
    if residual_power:
        # noise does not get smaller: signals that are scaled down leave less than healthy ones, and show no fault
        near = [correction for correction in near if QUIETEST_SHARE * residual_power < tried[correction][1]] or near
        near.sort(key=lambda similar: abs(np.log(max(tried[similar][1], 1e-300) / residual_power)))
    spreads = float(np.std(rows.r)), float(np.std(rows.y))
    opposed = min(spreads) > 0.0 and float(np.corrcoef(rows.r, rows.y)[0, 1]) < 0.0
    for correction in near:
        factor = correction.factors[2]
        together = replace(correction, factors=(factor, *correction.factors[1:]))
        if factor == -1.0:  # to a linear plant, u of the opposite sign is r and y of it
            yield from (correction,) if opposed else (replace(correction, factors=(1.0, -1.0, 1.0)), together)
        elif factor != 1.0 and min(spreads) > 0.0:
            both = abs(np.log(spreads[0] / spreads[1])) < np.log(2.0)
            yield from (together, correction) if both else (correction, together)
        else:
            yield correction


def begins_wrong(pipeline: Pipeline, theta: FloatArray, recording: Recording, correction: Correction) -> bool:
    """Return whether a correction explains the first motion of a recording better, too; a fault may begin later."""
    if correction.factors[1:] == (1.0, 1.0) and correction.order == (0, 1, 2):
        return True  # r in another unit, which the plant does not notice
    rows = _beginning(pipeline, recording)
    corrected = correction.apply(rows)
    before, _ = _residual_share(pipeline, theta, rows, BEGINNING_SHARE)
    after, _ = _residual_share(pipeline, theta, corrected, BEGINNING_SHARE)
    return after * HEALTHY_RESIDUAL_RATIO < before


def shrinks_misfit(pipeline: Pipeline, theta: FloatArray, recording: Recording, correction: Correction) -> bool:
    """Return whether a factor on a signal leaves so much less unexplained that no fault needs to be away."""
    rows = _beginning(pipeline, recording)
    before, after = (_residual_share(pipeline, theta, signals)[0] for signals in (rows, correction.apply(rows)))
    return correction.order == (0, 1, 2) and after * MIN_BELIEVED_RATIO < before


def describe_misfit(pipeline: Pipeline, theta: FloatArray, recording: Recording) -> Message | None:
    """Return what is wrong with signals that the plant with theta explains only when they are put right.

    For plants that are known roughly, as before learning.
    """
    rows = _beginning(pipeline, recording)
    if not _residual_share(pipeline, theta, rows)[0] > MIN_WRONG_SHARE:
        return None
    corrections = [
        correction
        for correction in find_corrections(pipeline, theta, None, rows)
        if _residual_share(pipeline, theta, correction.apply(rows))[0] < MAX_RIGHT_SHARE
    ]
    of_u = [correction for correction in corrections if abs(correction.factors[1]) != 1.0]
    of_y = [correction for correction in corrections if abs(correction.factors[2]) != 1.0]
    if of_u and of_y and of_y[0].factors[0] != 1.0:  # r agrees with y, so that both or u may be wrong
        return message("signals.unit_of_either", u=of_u[0].factors[1], y=of_y[0].factors[2])
    return (of_y or corrections)[0].description if corrections else None


def _lags(rows: Recording) -> bool:
    """Return whether y comes after r: by the way round in which both go through their plane."""
    r, y = rows.r - rows.r.mean(), rows.y - rows.y.mean()
    return float(((r[:-1] * y[1:] - y[:-1] * r[1:]) * ~rows.restart[1:]).sum()) > 0.0


def _beginning(pipeline: Pipeline, recording: Recording) -> Recording:
    return recording.rows(slice(0, min(round(MAX_MEMORIES * pipeline.memory_samples), MAX_ROWS)))


def _single_corrections() -> Iterator[Correction]:
    for order in ((2, 1, 0), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1)):
        yield Correction(order=order)
    yield Correction(factors=(1.0, 1.0, -1.0))
    for factor in FACTORS:
        yield Correction(factors=(1.0, 1.0, factor))
        yield Correction(factors=(1.0, factor, 1.0))


def _reference_corrections(rows: Recording) -> Iterator[Correction]:
    """Yield r in another unit, which the plant does not notice, where r is much larger or smaller than y."""
    spreads = float(np.std(rows.r)), float(np.std(rows.y))
    if min(spreads) > 0.0:
        ratio = spreads[1] / spreads[0]
        for factor in FACTORS:
            if abs(ratio / factor - 1.0) < UNIT_ERROR:
                yield Correction(factors=(factor, 1.0, 1.0))


def _residual_share(
    pipeline: Pipeline, theta: FloatArray, rows: Recording, beginning: float = 1.0
) -> tuple[float, float]:
    """Return the mean square of what the plant with theta leaves of eta: relative, and in units of eta.

    `beginning`: share of the rows in motion that is looked at.
    """
    g = pipeline.regression(rows.r, rows.u, rows.y, rows.restart)
    if not g.ok.any():
        return np.inf, np.inf
    used = np.flatnonzero(g.ok)[: int(np.ceil(beginning * g.ok.sum()))]
    left = float(np.mean((g.eta[used] - g.phi[used] @ theta) ** 2))
    whole = float(np.mean(g.eta[used] ** 2))
    return (left / whole if whole > 0.0 else np.inf), left


def _frozen_samples(recording: Recording) -> int:
    return max(MIN_FROZEN_SAMPLES, round(FROZEN_S * recording.sample_rate))


def _frozen_defect(recording: Recording, finding: QualityFinding, late: int) -> SignalDefect | None:
    name = finding.kind.removeprefix("frozen_")
    if name == "u" and find_switched_off(recording) is not None:
        return None
    if not finding.begins or name not in SIGNALS or not finding.value > 0.0:  # at rest nothing is demanded
        return None
    x: FloatArray = getattr(recording, name)
    at = int(np.searchsorted(recording.t, finding.time))
    begin = at
    while begin and x[begin - 1] == x[at]:
        begin -= 1
    moved = np.flatnonzero(x[begin:] != x[begin])
    stretch = slice(begin, begin + int(moved[0]) if len(moved) else recording.samples)
    low, high = outofcore.extremes(x)
    if name == "u" and not low < x[at] < high:
        return None  # it is limited
    if name == "y" and (_follows_late(recording, stretch, late) or _is_held(recording, stretch)):
        return None
    other = "r" if name == "y" else "r - y"
    text = message("signals.frozen", name=name, t=float(recording.t[begin]), other=other, by=finding.value)
    return SignalDefect(begin, text)


def _is_held(recording: Recording, stretch: slice) -> bool:
    """Return whether friction may hold y in a stretch, u hardly changing: a weak drive rests at its turning point."""
    return float(np.ptp(recording.u[stretch])) < FORCE_SHARE * float(np.ptp(outofcore.extremes(recording.u)))


def _follows_late(recording: Recording, stretch: slice, late: int) -> bool:
    """Return whether y, at rest in a stretch, moves within some samples of the motion of r that should move it.

    A rest before the command says nothing of the sensor, and a loop may take a while to break away.
    """
    travel = TRAVEL_SHARE * float(np.ptp(outofcore.extremes(recording.y)))
    r = recording.r[stretch]
    demanded = np.maximum.accumulate(r) - np.minimum.accumulate(r) > travel
    return bool(demanded.any()) and len(r) - int(np.argmax(demanded)) <= late


def _largest_near(steps: FloatArray, at: npt.NDArray[np.intp], lead: int) -> float:
    return max(float(steps[max(k - lead, 0) : k + 2].max()) for k in at.tolist())


def _find_jump(rows: Recording, first: int, lead: int) -> SignalDefect | None:
    steps = np.where(rows.restart[1:], 0.0, np.abs(np.diff(rows.y)))
    span = float(np.ptp(rows.y))
    jumps = np.flatnonzero(steps > JUMP_SHARE * span) if span > 0.0 else np.zeros(0, dtype=np.intp)
    if not len(jumps) or len(jumps) > MAX_JUMP_SHARE * len(steps):
        return None
    size, other = float(np.median(steps[jumps])), float(np.delete(steps, jumps).max(initial=0.0))
    after, before = np.abs(rows.r[1:] - rows.y[1:]), np.abs(rows.r[1:] - rows.y[:-1])
    if np.ptp(rows.r) > 0.0 and (after < before - 0.5 * size)[jumps].all():
        return None  # y answers r, however late
    demanded = _largest_near(np.abs(np.diff(rows.r)), jumps, lead)
    if MIN_STEP_RATIO * max(other, demanded) > size or np.ptp(steps[jumps]) > 2.0 * other:
        return None  # a motion, or jumps of several sizes
    begin = int(jumps[0]) + 1
    text = message("signals.jump", t=float(rows.t[begin]), size=size)
    return SignalDefect(first + begin, text)


def _judge(exam: Examination) -> Iterator[Finding]:
    if (off := find_switched_off(exam.recording)) is not None:
        yield Finding.throughout(exam, "doubt", "signals", off.description)


DEFECTS = EvidenceKind("", judge=_judge)
