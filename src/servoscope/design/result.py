"""What a study before deployment says, as data: one JSON object per loop, reference and noise."""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict

from servoscope.core.messages import MessageText

SIZES = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # detectability radii whose delays are told

Spans = tuple[tuple[float, float | None], ...]


class _StudyModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class DetectionDelay(_StudyModel):
    """How soon a fault of one size is announced: probability in time, and times [s] by which half and 90 % are."""

    ratio: float
    probability: float
    half_s: float | None
    most_s: float | None


class DirectionStudy(_StudyModel):
    """One direction of a fault.

    Parameters
    ----------
    detectable
        Ratio from which on the monitor announces it in time with 90 % probability; None: nowhere in its range.
    delays
        How soon, by size.
    unclear
        Spans of ratios at which it is not named rightly with 99.5 % probability, from the smallest change on; an open
        end is None.
    certain
        The same if the healthy parameters were known exactly: no diagnosis can do better.
    bound
        End of the first span as linear sensitivities and the Cramer-Rao bound have it.
    nearest
        Fault that it is taken for, if any.
    called
        Probability of each other name at the ratio `detectable`.
    tracking, stability
        Ratio from which on the loop no longer follows its reference, or has lost half of its margin of stability; None:
        nowhere in its range, or a study of before this was asked.
    """

    detectable: float | None
    delays: tuple[DetectionDelay, ...]
    unclear: Spans
    certain: Spans
    bound: float | None
    nearest: str
    called: dict[str, float]
    tracking: float | None = None
    stability: float | None = None

    @property
    def isolable(self) -> float | None:
        """Ratio from which on it is named rightly; None: nowhere in its range."""
        return self.unclear[-1][1] if self.unclear else 1.0

    @property
    def first_isolable(self) -> float | None:
        """Smallest ratio at which it is named rightly, though larger ones may be unclear again."""
        return self.unclear[0][1] if self.unclear else 1.0

    @property
    def times_bound(self) -> float | None:
        """`first_isolable` against `bound`, as logarithms; None where one of them does not exist."""
        if self.first_isolable is None or self.bound is None or self.bound == 1.0:
            return None
        return math.log(self.first_isolable) / math.log(self.bound)

    def clear(self, ratio: float) -> bool:
        """Return whether a fault of this ratio is named rightly."""
        x = abs(math.log(ratio))
        return not any(abs(math.log(a)) <= x and (b is None or x <= abs(math.log(b))) for a, b in self.unclear)


class SizePrecision(_StudyModel):
    """Smallest standard deviation of a size, relative, so many seconds after the onset; None: nothing tells it.

    `alone` if nothing else may have changed, `together` if all parameters may; `alone_learned` and `together_learned`
    with the healthy ones known only as the baseline and the seconds before the onset know them.
    """

    seconds: float
    alone: float | None
    together: float | None
    alone_learned: float | None
    together_learned: float | None


class FaultStudy(_StudyModel):
    """One fault: `information` is Fisher's about the logarithm of its ratio, per second."""

    name: str
    parameter: str
    information: float
    sizes: tuple[SizePrecision, ...]
    up: DirectionStudy
    down: DirectionStudy


class PairStudy(_StudyModel):
    """Two faults at once, nothing else: standard deviations of both sizes and their correlation."""

    names: tuple[str, str]
    std: tuple[float | None, float | None]
    correlation: float


class JointStudy(_StudyModel):
    """All parameters at once; the standard deviation is None where another change can take a size's place.

    `confused` are the shares of each parameter's logarithm in the combination that is known worst, the largest 1, and
    `worst` the standard deviation along it as a multiple of what it would be if they did not overlap.
    """

    parameters: tuple[str, ...]
    std: tuple[float | None, ...]
    correlation: tuple[tuple[float, ...], ...]
    confused: dict[str, float]
    worst: float


class MimicStudy(_StudyModel):
    """A change that is no fault of the list, and the one that it looks like.

    Parameters
    ----------
    amount, unit
        Size of the change that `looks_like` is told for: 0.01 relative, or a tenth of a sample.
    cosines
        Between its innovations and those of each fault.
    imitates, looks_like
        The fault with the largest cosine, and the ratio that it seems to have.
    told_apart
        Amount from which on it is told from that fault; None: never.
    """

    name: str
    words: MessageText
    amount: float
    unit: str
    cosines: dict[str, float]
    imitates: str
    looks_like: float
    told_apart: float | None


class FrequencyStudy(_StudyModel):
    """One frequency of the iFRF: standard deviations of each size as seen there, alone and apart from all others."""

    frequency_hz: float
    alone: dict[str, float | None]
    apart: dict[str, float | None]


class FrequencyComparison(_StudyModel):
    """Frequencies to monitor: the loop's and the best; `gain` is the mean factor in what sets the faults apart."""

    own: tuple[FrequencyStudy, ...]
    best: tuple[FrequencyStudy, ...]
    gain: float


class DitherStudy(_StudyModel):
    """A sine on the reference; `radius` as ratios, of linear sensitivities, and `std` relative, by fault."""

    frequency_hz: float
    share: float
    amplitude: float
    extra_u_rms: float
    std: dict[str, float | None]
    radius: dict[str, float | None]


class DesignStudy(_StudyModel):
    """Which faults of a loop can be seen and told apart, at which size, after how long.

    Parameters
    ----------
    loop, reference
        What is studied.
    units
        Of y and u; empty where they are not known.
    before_s, after_s
        Healthy seconds before the onset, and seconds after it that count.
    noise_u_std, noise_y_std
        Of the loop.
    false_alarms_per_year
        Budget.
    faults
        By name.
    cosines
        Between what small faults do, by their names; what errors of the healthy parameters explain is left out.
    joint, pairs
        Several faults at once.
    mimics
        What else the faults could be.
    frequencies, dither
        What to monitor, and what a sine on the reference would buy; the first dither is none.
    """

    loop: str
    reference: MessageText
    units: tuple[str, str]
    before_s: float
    after_s: float
    noise_u_std: float
    noise_y_std: float
    false_alarms_per_year: float
    faults: dict[str, FaultStudy]
    cosines: dict[str, dict[str, float]]
    joint: JointStudy
    pairs: tuple[PairStudy, ...]
    mimics: tuple[MimicStudy, ...]
    frequencies: FrequencyComparison
    dither: tuple[DitherStudy, ...]
