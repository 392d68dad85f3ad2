"""What a refit finds: its hypotheses with their probabilities, what is left unexplained, and since when."""

from __future__ import annotations

from dataclasses import dataclass

from servoscope.isolation.ml.goodness_of_fit import GoodnessOfFit
from servoscope.isolation.ml.hypothesis import HypothesisEvidence, HypothesisFit
from servoscope.isolation.ml.onset import OnsetEstimate
from servoscope.isolation.ml.window import ChangeWindow


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation: its fit, its evidence and its probability."""

    fitted: HypothesisFit
    evidence: HypothesisEvidence
    probability: float

    @property
    def name(self) -> str:
        """Names of its faults, joined by plus signs."""
        return " + ".join(fault.name for fault in self.fitted.faults)

    @property
    def has_name(self) -> bool:
        """Whether its sizes lie within their ranges, and are not such that all of them may be healthy."""
        return not self.fitted.faults_at_ends and not all(low <= 0.0 <= high for low, high in self.evidence.intervals)


@dataclass(frozen=True, eq=False)
class RefitResult:
    """Result of the refit."""

    window: ChangeWindow  # what it looked at
    hypotheses: tuple[Hypothesis, ...]  # most probable first
    other_parameters: tuple[HypothesisFit, ...]  # outside the list of faults, each as if it alone had changed
    unknown_probability: float  # probability that it is none of the hypotheses
    goodness: GoodnessOfFit  # of the most probable one
    onset: OnsetEstimate  # onset, in samples of the window
    noise_variance: float  # variance of the innovations under it, 1 for the baseline's noise
    initial_onset: int  # sample of the window from which the search for the onset started
    latest: int  # and up to which it went

    @property
    def is_unknown(self) -> bool:
        """Whether none of the hypotheses is the most probable answer."""
        return self.unknown_probability > self.best.probability

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]
