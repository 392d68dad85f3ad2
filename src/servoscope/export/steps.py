"""The steps of one sample and of an evaluation as statements, traced from the text that the monitor itself runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from servoscope.core.jit.c_source import CPrinter, CRows
from servoscope.core.jit.symbolic import Float
from servoscope.estimation import estimators
from servoscope.estimation.kernel.cusum import update_cusum, update_cusum_by_sums
from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import SampleSteps
from servoscope.estimation.kernel.spec import KernelSpec

DOUBLES = frozenset({"h", "status", "when", "extra"})  # arrays of doubles, whatever most numbers are

StepTexts = dict[str, list[str]]


@dataclass(frozen=True)
class StepTracer:
    """Writes the steps of a monitor as statements of a language.

    Parameters
    ----------
    spec
        Sizes of the monitor.
    printer
        Returns a printer of the language.
    names
        What arrays are called that have another name there than in `estimation.kernel.sample_steps`.
    places
        Of the arrays whose elements have names of their own, these by row: ``tile``, a sample, and ``q``, an
        evaluation.
    due
        The condition that an update is due.
    """

    spec: KernelSpec
    printer: Callable[[], CPrinter]
    names: Mapping[str, str]
    places: Mapping[str, dict[int, str]]
    due: str

    def write_steps(self) -> StepTexts:
        """Return the statements of each step by its name, without the loop over the CUSUMs."""
        spec, size, evaluation = self.spec, self.spec.sizes, EvaluationSteps(self.spec)
        steps = SampleSteps(spec, estimators.load_estimator(spec.estimator), single_lane=True)

        def advance_filters(c: Any, s: Any, h: Any, v: Any, shadow: Any, status: Any, tile: Any) -> None:
            due = s.printer.condition(self.due)
            steps.advance_filters(c, s, h, status, v, shadow, tile, 0, due)

        def evaluate(c: Any, s: Any, h: Any, q: Any) -> None:
            evaluation.write_evaluation(c, s, h, q)
            for f in range(size.frequencies):
                evaluation.write_response(c, s, h, f, q)

        texts = {
            "begin_filters": self._trace(partial(steps.begin_filters, i=0), "c s h tile"),
            "advance_filters": self._trace(advance_filters, "c s h v shadow status tile"),
            "reset_noise": self._trace(steps.reset_noise, "s h"),
            "update_estimate": self._trace(steps.update_estimate, "c s h v shadow e extra"),
            "evaluate": self._trace(evaluate, "c s h q"),
        }
        if size.shadow:
            texts["begin_evaluation"] = self._trace(steps.begin_evaluation, "s h")
        if size.watched and spec.sums:
            texts["end_evaluation"] = self._trace(steps.end_evaluation, "s h top")
        elif size.watched:
            store = self._trace(partial(steps.store_residual, i=0), "c s h status e w when")
            alarm = self._trace(partial(steps.update_alarm, i=0), "s h top when")
            texts |= {"store_residual": store, "update_alarm": alarm}
        return texts

    def write_cusum(self, observed: str, *targets: str) -> list[str]:
        """Return what happens to CUSUM j; `observed`: the array of what it takes, or of the sums of an evaluation."""
        printer, spec, g = self.printer(), self.spec, f"{self.names.get('g', 'g')}[j]"
        constants, tail, count = self.names.get("c", "c"), dict(spec.at)["tail"], spec.sums or spec.columns + 1
        table = [printer.read(f"{constants}[{tail + spec.sizes.watched * k} + j]") for k in range(count)]
        begin = dict(spec.to)["sums"] if spec.sums and observed == self.names.get("s") else 0
        *psi, last = [printer.read(f"{observed}[{begin + k}]") for k in range(count)]
        new: Float
        if spec.sums:
            new = update_cusum_by_sums(table, [*psi, last], printer.read(g))
        else:
            new = update_cusum(table[:-1], psi, last, printer.read(g), table[-1])
        for target in (g, *targets):
            printer.store(new.kind, new.text, target)
        return printer.lines()

    def _trace(self, step: Callable[..., Any], parameters: str) -> list[str]:
        """Return the statements of a step, which is called with one array per parameter."""
        printer = self.printer()
        rows = [CRows(printer, self.names.get(x, x), self.places.get(x), wide=x in DOUBLES) for x in parameters.split()]
        step(*rows)
        for row in rows:
            row.flush()
        return [*printer.declarations(), *printer.lines()]


def evaluation_names(n: int, responses: Iterable[str]) -> dict[int, str]:
    """Return what the numbers of an evaluation are called; `responses`: those of the frequency response."""
    names = ["updates", "statistic", "level", "crossed_s", *(f"theta[{i}]" for i in range(n))]
    return dict(enumerate([*names, *(f"covariance[{i}]" for i in range(n * n)), *responses]))
