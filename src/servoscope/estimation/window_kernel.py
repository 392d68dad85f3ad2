"""The recursion of `servoscope.estimation.window_features`, compiled: several assets, one after the other.

A row of constants: window, levels, span, settling, number of edges, number of bands, speed of rest, rate, smoothing;
then edges [samples], b and both a of the band-pass filters.

A state: armed, sample, samples of the window, windows of the span, span, reference before, speed, 4 times the samples
since the motion began plus the motion; then filters, then sums level by level.
"""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import Int, where
from servoscope.core.jit.array_function import ArrayFunction
from servoscope.core.jit.arrays import Array, Variable
from servoscope.core.jit.memory import Memory, apply

HEADER = 8  # numbers of the state before those of the filters
ROW_HEADER = 3  # numbers of a row before the sums: sample, level, span
MAX_PHYSICAL = 1e100  # as in the recursion: no physical signal, and it would stay in the filters for ever


@ArrayFunction
def accumulate_windows(
    printer: Any, table: Any, states: Any, begins: Any, R: Any, U: Any, Y: Any, restarts: Any, out: Any, lane: Any,
    rows: Any, *, bands: int,
) -> Any:  # fmt: skip
    """Feed a block of samples of the assets with so many bands; write a row per window that ended behind `rows` others.

    Returns how many rows there are then; see `WindowLanes.run` for the arguments; `out`, `lane`: rows of windows and
    whose they are.
    """
    count = Variable(printer, rows)
    for asset in printer.loop(0, table.shape[0]):
        with printer.when(table[asset, 5].is_equal(float(bands))):
            place = printer.place("double", states.base, asset * states.shape[1] + begins[asset])
            s = Array(printer, place, "double", (0,))
            windows = _AssetWindows(printer, table[asset], s, bands, (out, lane, count, asset))
            windows.process(R[asset], U[asset], Y[asset], restarts[asset])
    return count.value


class _AssetWindows:
    """Writes how samples of one asset are processed: c are its constants, s is its state.

    The band-passes of u, then those of e, are the lanes of vectors.
    """

    def __init__(self, printer: Any, c: Any, s: Any, bands: int, rows: tuple[Any, ...]) -> None:
        self.printer, self.c, self.s, self.bands, self.rows = printer, c, s, bands, rows
        self.levels, self.edges = printer.truncate(c[1]), printer.truncate(c[4])
        self.bins, self.begin = (self.edges + 1) * 3, HEADER + 8 * bands
        self.sums, self.powers = self.bins * 3 + 3 * (2 * bands + 1), self.bins * 3 + (self.begin + 1)
        self.weights, self.filters, self.square = (
            Array.scratch(printer, "double", count, 2 * bands) for count in (3, 4, 4)
        )
        self.vectors = [
            Memory(printer, array.base, "double", 2 * bands) for array in (self.weights, self.filters, self.square)
        ]

    def process(self, r: Any, u: Any, y: Any, restart: Any) -> None:
        """Write how a block of samples is processed."""
        printer, c, s, bands, when = self.printer, self.c, self.s, self.bands, self.printer.when
        lanes = [(j * bands + band, j, band) for j in range(2) for band in range(bands)]
        for i, j, band in lanes:
            for row in range(3):
                self.weights[row, i] = c[self.edges + (9 + row * bands + band)]
                self.square[row, i] = s[self.powers + ((3 * j + row) * bands + band)]
            for row in range(4):
                self.filters[row, i] = s[HEADER + 4 * (2 * band + j) + row]
            self.square[3, i] = 0.0
        armed, sample, before, speed = (Variable(printer, s[i]) for i in (0, 1, 5, 6))
        moving = Variable(printer, printer.truncate(s[7]))
        for k in printer.loop(0, r.shape[0]):
            sample.value = sample.value + 1.0
            known = (abs(r[k]) < MAX_PHYSICAL) & (abs(u[k]) < MAX_PHYSICAL) & (abs(y[k]) < MAX_PHYSICAL)
            with when(~known):
                armed.value = 0.0
            with when(known):
                error = r[k] - y[k]
                with when((restart[k] > 0) | armed.value.is_equal(0.0)):
                    armed.value, before.value, speed.value, moving.value, s[2] = 1.0, r[k], 0.0, 0, 0.0
                    # a band-pass has forgotten a constant: it starts where a signal has always been what it is now
                    for i, j, _ in lanes:
                        self.filters[0, i] = self.filters[1, i] = -self.weights[0, i] * (error if j else u[k])
                        self.filters[2, i] = self.filters[3, i] = 0.0
                    self._clear_square()
                    self._clear_sums(self.begin, self.levels * (self.sums + 1))
                speed.value = speed.value + c[8] * ((r[k] - before.value) * c[7] - speed.value)
                before.value = r[k]
                backward = where(speed.value < -c[6], Int(printer, "1"), 2)
                motion = where(speed.value > c[6], 0, backward)
                goes_on = (moving.value % 4).is_equal(motion)
                moving.value = where(goes_on, moving.value + 4, motion)
                settled = sample.value > c[3]
                apply(self._filter, *self.vectors, u[k], error, where(settled, motion, 3))
                with when(settled):
                    self._add_sample(u[k], error, speed.value, motion, moving.value // 4)
                    with when(s[2] >= c[0]):
                        self._store_powers(lanes)
                        self._clear_square()
                        self._close_window(sample.value)
        self._store_powers(lanes)
        for i, j, band in lanes:
            for row in range(4):
                s[HEADER + 4 * (2 * band + j) + row] = self.filters[row, i]
        s[0], s[1], s[5], s[6], s[7] = (
            armed.value,
            sample.value,
            before.value,
            speed.value,
            printer.number(moving.value),
        )

    def _filter(self, weights: Any, filters: Any, square: Any, u: Any, error: Any, row: Any) -> None:
        """Pass u and e twice through the band-passes, and add the squares of what passes."""
        printer, kind = self.printer, weights.kind
        b, a, a_last = (weights[i] for i in range(3))
        value = type(b)(printer, printer.gather("double", [u.text] * self.bands + [error.text] * self.bands), kind)
        first = b * value + filters[0]
        filters[0] = filters[1] - a * first
        filters[1] = -b * value - a_last * first
        passed = b * first + filters[2]
        filters[2] = filters[3] - a * passed
        filters[3] = -b * first - a_last * passed
        square[row] = square[row] + passed * passed

    def _add_sample(self, u: Any, error: Any, speed: Any, motion: Any, since: Any) -> None:
        """Add a sample to its bin, which its motion and the time since that began give."""
        printer, s, place = self.printer, self.s, Variable(self.printer, motion * (self.edges + 1))
        for edge in printer.loop(0, self.edges):
            place.value = place.value + where(printer.number(since) >= self.c[edge + 9], Int(printer, "1"), 0)
        at = place.value + (self.begin + 1)
        for index, number in ((at + self.bins, u), (at + self.bins * 2, error), (at, 1.0)):
            s[index] = s[index] + number
        moved = self.powers + motion + 6 * self.bands
        s[moved] = s[moved] + speed * speed
        s[2] = s[2] + 1.0

    def _close_window(self, sample: Any) -> None:
        """Write rows of windows that end with a sample: one of the next level is two of this one."""
        printer, s, begin, sums, (out, lane, rows, asset) = self.printer, self.s, self.begin, self.sums, self.rows
        s[2], s[3], windows = 0.0, s[3] + 1.0, Variable(printer, 1.0)
        for level in printer.loop(0, self.levels):
            at = level * (sums + 1) + begin
            with printer.when(level > 0):
                for i in printer.loop(1, sums + 1):
                    s[at + i] = s[at + i] + s[i + begin]
            s[at] = s[at] + 1.0
            with printer.when(s[at] >= windows.value):
                row, lane[rows.value] = out[rows.value], asset
                row[0], row[1], row[2] = sample, printer.number(level), s[4]
                for i in printer.loop(0, sums):
                    row[i + ROW_HEADER] = s[at + i + 1]
                rows.value = rows.value + 1
                with printer.when(level > 0):
                    self._clear_sums(at, sums + 1)
            windows.value = windows.value * 2.0
        self._clear_sums(begin, sums + 1)
        with printer.when(s[3] >= self.c[2]):  # all begin anew where a span ends
            s[3], s[4] = 0.0, s[4] + 1.0
            self._clear_sums(begin, self.levels * (sums + 1))

    def _clear_square(self) -> None:
        for row in range(4):
            for i in range(2 * self.bands):
                self.square[row, i] = 0.0

    def _clear_sums(self, begin: Any, count: Any) -> None:
        for i in self.printer.loop(0, count):
            self.s[i + begin] = 0.0

    def _store_powers(self, lanes: list[tuple[int, int, int]]) -> None:
        for i, j, band in lanes:
            for row in range(3):
                self.s[self.powers + ((3 * j + row) * self.bands + band)] = self.square[row, i]
