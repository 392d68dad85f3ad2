"""The functions of a recursion as machine code: a block of many assets, one sample, evaluations, regressors of a log.

A lane is an asset. Where no lane is disturbed, the samples of a tile go through all of them in a few loops; else one by
one, and what happens in some lanes only is masked in the others.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Sequence
from typing import Any

from servoscope.core.jit import where
from servoscope.core.jit.arrays import Variable
from servoscope.core.jit.llvm_text import LlvmPrinter, vector
from servoscope.core.jit.memory import Memory, apply, repeat
from servoscope.core.jit.native import native_function
from servoscope.core.jit.symbolic import Bool, Float, Int, maximum, minimum
from servoscope.estimation import estimators
from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import CUSUM_BATCH, HEADER_SIZE, MISSING, SAMPLE, TILE, SampleSteps
from servoscope.estimation.kernel.spec import KernelSpec

LINE = 8  # numbers of a cache line, and rows of a square that is transposed at once

Arguments = tuple[tuple[str, str], ...]
BLOCKS: Arguments = (
    *((name, "ptr") for name in ("constants", "state", "new", "r", "u", "y", "restart", "out")),
    *((name, "i64") for name in ("constant_step", "assets", "samples", "restarts", "every", "stride", "out_step")),
    *(("begin", "i64"), ("end", "i64")),
)
SINGLE: Arguments = (("constants", "ptr"), ("state", "ptr"), ("r", "double"), ("u", "double"), ("y", "double"))
EVALUATION: Arguments = (
    *((name, "ptr") for name in ("constants", "state", "out")),
    *(("constant_step", "i64"), ("assets", "i64")),
)
REGRESSORS: Arguments = (
    *((name, "ptr") for name in ("constants", "state", "r", "u", "y", "restart", "out", "status")),
    *(("samples", "i64"), ("stride", "i64")),
)


class LaneBlock:
    """The lanes of a block: their memory, and what happens to them."""

    def __init__(self, printer: LlvmPrinter, spec: KernelSpec, lanes: int, element: str) -> None:
        self.p, self.spec, self.size, self.lanes, self.element = printer, spec, spec.sizes, lanes, element
        estimator = estimators.load_estimator(spec.estimator)
        self.steps, self.evaluation = SampleSteps(spec, estimator, lanes == 1), EvaluationSteps(spec)

        def memory(rows: int, element: str = element, scratch: bool = False) -> Memory:
            return Memory(printer, printer.stack(element, rows * lanes), element, lanes, scratch=scratch)

        size = self.size
        self.h, self.s, self.g = memory(HEADER_SIZE, "double"), memory(size.floats), memory(size.watched)
        self.tile, self.status = memory(4 * TILE), memory(1, "double")
        self.v, self.shadow = memory(size.rows, scratch=True), memory(spec.shadow_rows, scratch=True)
        self.e = memory(2, scratch=True)
        self.w, self.when = memory((self.steps.columns + 1) * TILE), memory(TILE, "double")
        # CUSUMs of one asset side by side, or those of several
        self.cusum_lanes = CUSUM_BATCH if lanes == 1 else lanes
        self.top = Memory(printer, printer.stack(element, TILE * self.cusum_lanes), element, self.cusum_lanes)
        self.level = memory(TILE) if lanes == 1 else self.top
        self.phase = Variable(printer, 0)

    def process(self, c: Memory, begin: Any, end: Any, stride: Int, first: Bool, last: Bool, extra: Memory) -> None:
        """Write how samples of the tile are processed; `first` and `last` begin and end an evaluation."""
        p, steps, size, spec = self.p, self.steps, self.size, self.spec
        if size.shadow:
            with p.when(first):
                apply(steps.begin_evaluation, self.s, self.h)
        if size.steady and not size.speed and isinstance(end, Int):
            apply(steps.clear_size, self.e)
            repeat(steps.accumulate_size, begin, end, self.e, self.tile, kept=(self.e,))
            undisturbed = p.holds("and", apply(steps.is_undisturbed, self.h, self.e)) & stride.is_equal(1)
            with p.when(undisturbed):
                self._process_undisturbed(c, begin, end)
            with p.when(~undisturbed):
                self._process_each(c, begin, end, stride, extra)
        else:
            self._process_each(c, begin, end, stride, extra)
        if not size.watched:
            return
        if not spec.sums:
            self._update_cusums(c, self.w, begin, end)
            repeat(steps.update_alarm, begin, end, self.s, self.h, self.level, self.when, kept=(self.s, self.h))
            return
        with p.when(last):  # the CUSUMs step once, with what the evaluation's samples sum up to
            self._update_cusums(c, self.s.behind(dict(spec.to)["sums"]), 0, 1)
            apply(steps.end_evaluation, self.s, self.h, self.level)

    def _process_undisturbed(self, c: Memory, begin: Int, end: Int) -> None:
        """Write one loop after the other: the state of each has room in registers."""
        steps, s, h, kept = self.steps, self.s, self.h, (self.s, self.h)
        if self.size.shadow:
            repeat(steps.advance_shadow, begin, end, c, s, self.w, self.tile, kept=(s,))
        repeat(steps.update_undisturbed, begin, end, c, s, h, self.w, self.when, self.tile, kept=kept)
        if self.size.shadow:
            repeat(steps.whiten_undisturbed, begin, end, c, s, h, self.w, kept=kept)

    def _process_each(self, c: Memory, begin: Any, end: Any, stride: Int, extra: Memory) -> None:
        """Write how samples are processed one by one, whatever their status."""
        p, steps = self.p, self.steps
        for i in p.loop(begin, end):
            phase = self.phase.value + 1
            due = phase.is_equal(stride)
            self.phase.value = where(due, 0, phase)
            self.filter_sample(c, i, due)
            used, rests = apply(steps.classify_update, self.status)
            with p.when(p.holds("or", used)):
                apply(
                    steps.update_estimate, c, self.s, self.h, self.v, self.shadow, self.e, extra, mask=self._mask(used)
                )
            with p.when(p.holds("or", rests)):
                apply(steps.reset_noise, self.s, self.h, mask=self._mask(rests))
            if self.size.watched and not self.spec.sums:
                apply(steps.store_residual, c, self.s, self.h, self.status, self.e, self.w, self.when, i)

    def filter_sample(self, c: Memory, i: Any, due: Bool) -> None:
        """Write how a sample passes the filters; after a gap, which a missing sample is, they begin in steady state."""
        p, steps = self.p, self.steps
        complete, begins = apply(steps.classify_sample, self.h, self.status, self.tile, i)
        with p.when(p.holds("or", begins)):
            apply(steps.begin_filters, c, self.s, self.h, self.tile, i, mask=self._mask(begins))
        every = Bool(p, p.broadcast("i1", due.text, self.lanes), vector("i1", self.lanes))
        with p.when(p.holds("or", complete)):
            arguments = c, self.s, self.h, self.status, self.v, self.shadow, self.tile, i, every
            apply(steps.advance_filters, *arguments, mask=self._mask(complete))

    def _mask(self, condition: Bool) -> Bool | None:
        return None if self.lanes == 1 else condition  # of one lane it is known where it holds

    def _update_cusums(self, c: Memory, observed: Memory, begin: Any, end: Any) -> None:
        p, lanes, tail = self.p, self.cusum_lanes, dict(self.spec.at)["tail"]
        for i in p.loop(begin, end):
            self.top.store(i, p.constant(0.0, self.top.kind))
        update = self.steps.update_cusums_by_sums if self.spec.sums else self.steps.update_cusums
        if self.lanes == 1:
            weights, g = c.behind(tail).regrouped(lanes), self.g.regrouped(lanes)
            repeat(update, begin, end, weights, g, observed.regrouped(lanes, shared=True), self.top, kept=(g,))
            for i in p.loop(begin, end):
                apply(self.steps.reduce_cusums, self.top.regrouped(1), self.level, i)
            return
        for j in p.loop(0, self.size.watched, CUSUM_BATCH):
            g = self.g.behind(j)
            repeat(update, begin, end, c.behind(j + tail), g, observed, self.top, kept=(g,))

    def evaluate(self, c: Memory, q: Memory) -> None:
        """Write an evaluation of every lane to q."""
        if self.size.start:
            apply(self.evaluation.write_internal, self.s, self.h, q)
            return
        apply(self.evaluation.write_evaluation, c, self.s, self.h, q)
        for f in self.p.loop(0, self.size.frequencies):
            apply(self.evaluation.write_response, c, self.s, self.h, f, q)

    # states and samples between the arrays of a fleet and the lanes

    def copy_states(self, state: str, places: Sequence[Int], *, out: bool) -> None:
        """Write how states, which begin at some places, are copied to the lanes, or the lanes to them."""
        for memory, begin, count in self._parts:
            self.copy(memory, count, [place + begin for place in places], state, "double", out=out)

    def fetch(self, signals: Sequence[str], places: Sequence[Int], samples: Int) -> None:
        """Write how samples from some places on are copied to the tile, as many as it holds."""
        p, parts = self.p, [self.tile.behind(k * TILE) for k in range(len(signals))]
        short = samples < TILE
        with p.when(short) if self.lanes > 1 else contextlib.nullcontext():
            for i in p.loop(0, minimum(samples, TILE)):
                for part, base in zip(parts, signals, strict=True):
                    self._copy_row(part, i, places, base, self.element, out=False)
        if self.lanes == 1:
            return
        with p.when(~short):
            for j in p.loop(0, TILE, LINE):
                for part, base in zip(parts, signals, strict=True):
                    self._transpose(part, j, places, base, self.element, out=False)
            for place in places:
                for base in signals:
                    for ahead in range(TILE, 2 * TILE, LINE):
                        p.prefetch(p.place(self.element, base, place + ahead))

    def fetch_restarts(self, restart: str, places: Sequence[Int], samples: Int) -> None:
        """Write how flags from some places on are copied to the tile."""
        p, part = self.p, self.tile.behind(3 * TILE)
        for i in p.loop(0, minimum(samples, TILE)):
            flags = p.gather("i8", [p.load("i8", p.place("i8", restart, place + i)) for place in places])
            part.store(i, p.assign(f"uitofp {vector('i8', self.lanes)} {flags} to {part.kind}"))

    def clear_restarts(self) -> None:
        """Write that no sample of a tile restarts."""
        for i in self.p.loop(0, TILE):
            self.tile.store(i + 3 * TILE, self.p.constant(0.0, self.tile.kind))

    @property
    def _parts(self) -> tuple[tuple[Memory, int, int], ...]:
        """The parts of a state, their places in it and their sizes."""
        floats, watched = self.size.floats, self.size.watched
        header = (self.h, 0, HEADER_SIZE)
        return header, (self.s, HEADER_SIZE, floats), (self.g, HEADER_SIZE + floats, watched)

    def copy(self, memory: Memory, count: int, places: Sequence[Int], base: str, element: str, *, out: bool) -> None:
        """Write how rows of lanes are copied from or to an array in which the numbers of a lane are neighbours."""
        p = self.p
        if self.lanes > 1 and count >= LINE:
            for begin in p.loop(0, count, LINE):
                self._transpose(memory, minimum(begin, count - LINE), places, base, element, out=out)
            return
        rows: Iterable[Int | int] = p.loop(0, count) if memory is self.g else range(count)
        for row in rows:
            self._copy_row(memory, row, places, base, element, out=out)

    def _copy_row(
        self, memory: Memory, i: Int | int, places: Sequence[Int], base: str, element: str, *, out: bool
    ) -> None:
        """Write how a row of lanes is copied, number by number."""
        p = self.p
        for lane, place in enumerate(places):
            here = memory.element, p.place(memory.element, memory.base, i * self.lanes + lane)
            there = element, p.place(element, base, place + i)
            source, target = (here, there) if out else (there, here)
            self._store(target, Float(p, p.load(*source), source[0]))

    def _store(self, target: tuple[str, str], number: Float) -> None:
        """Write how a number, or a vector, is stored in the precision of its place."""
        kind, place = target
        self.p.store(kind, Float(self.p, "", kind).to_operand(number), place)

    def _transpose(
        self, memory: Memory, row: Int, places: Sequence[Int], base: str, element: str, *, out: bool
    ) -> None:
        """Write how a square of rows and lanes is copied, one after the other."""
        p, of_lanes, of_memory = self.p, vector(element, LINE), vector(memory.element, LINE)
        for lane in range(0, self.lanes, LINE):
            there = [p.place(element, base, place + row) for place in places[lane : lane + LINE]]
            here = [p.place(memory.element, memory.base, (row + k) * self.lanes + lane) for k in range(LINE)]
            source, target = ((of_memory, here), (of_lanes, there)) if out else ((of_lanes, there), (of_memory, here))
            columns = p.transpose(source[0], [p.load(source[0], place) for place in source[1]])
            for column, place in zip(columns, target[1], strict=True):
                self._store((target[0], place), Float(p, column, source[0]))


def run_blocks(p: LlvmPrinter, spec: KernelSpec, lanes: int, element: str, own: bool) -> None:
    """Write the blocks of lanes from `begin` to `end`: r, u, y (assets, N) lead from `state` to `new` and `out`.

    `constants` (blocks, constant_step) has one row if all share it, and then the step is 0.
    """
    block, size = LaneBlock(p, spec, lanes, element), spec.sizes
    whole = {name: p.argument(name) for name, kind in BLOCKS if kind == "i64"}
    samples, every, stride, assets = (whole[name] for name in ("samples", "every", "stride", "assets"))
    floats, private = HEADER_SIZE + size.floats + size.watched, size.extra
    q = Memory(p, p.stack(element, size.row * lanes), element, lanes)
    k, since, window, column = (Variable(p, 0) for _ in range(4))
    for b in p.loop(whole["begin"], whole["end"]):
        place = p.place(element, "%constants", b * whole["constant_step"])
        c = Memory(p, place, element, lanes, shared=lanes > 1 and not own)
        row = [minimum(b * lanes + lane, assets - 1) for lane in range(lanes)]  # the last one fills what is left
        states = [asset * (floats + private) for asset in row]
        block.copy_states("%state", states, out=False)
        block.clear_restarts()
        for i in p.loop(0, private):
            at = states[0] + floats + i
            p.store("double", p.load("double", p.place("double", "%state", at)), p.place("double", "%new", at))
        extra = Memory(p, p.place("double", "%new", states[0] + floats), "double")
        number = p.truncate(Float(p, p.load("double", p.place("double", "%state", SAMPLE)), "double"))
        since.value = number % every
        block.phase.value = number % stride
        k.value = 0
        column.value = 0
        window.value = -TILE
        for _ in p.loop_while(lambda: k.value < samples):
            count = minimum(minimum(samples - k.value, every - since.value), TILE)
            with p.when(k.value + count > window.value + TILE):
                window.value = maximum(minimum(k.value, samples - TILE), 0)
                places = [asset * samples + window.value for asset in row]
                block.fetch(("%r", "%u", "%y"), places, samples)
                with p.when(whole["restarts"] > 0):
                    block.fetch_restarts("%restart", places, samples)
            begin, ends = k.value - window.value, since.value + count
            last = ends.is_equal(every)
            block.process(c, begin, begin + count, stride, since.value.is_equal(0), last, extra)
            k.value = k.value + count
            since.value = where(last, 0, ends)
            with p.when(last):
                block.evaluate(c, q)
                places = [asset * whole["out_step"] + column.value for asset in row]
                block.copy(q, size.row, places, "%out", element, out=True)
                column.value = column.value + size.row
        block.copy_states("%new", states, out=True)


def run_sample(p: LlvmPrinter, spec: KernelSpec, lanes: int, element: str, own: bool) -> None:
    """Write one sample of one asset, in place; the result says whether an evaluation is due."""
    block, size, zero = LaneBlock(p, spec, 1, element), spec.sizes, Int(p, "0")
    c, state = Memory(p, "%constants", element), Memory(p, "%state", "double")

    def whole(memory: Memory, row: int) -> Int:
        return p.truncate(Float(p, memory.load(row), memory.kind))

    every, stride, number = whole(c, 0), whole(c, 1), whole(state, SAMPLE)
    block.copy_states("%state", [zero], out=False)
    for k, name in enumerate(("%r", "%u", "%y", p.constant(0.0, "double"))):
        block.tile.store(k * TILE, name)
    block.phase.value = number % stride
    last = ((number + 1) % every).is_equal(0)
    extra = state.behind(HEADER_SIZE + size.floats + size.watched)
    block.process(c, 0, 1, stride, (number % every).is_equal(0), last, extra)
    block.copy_states("%state", [zero], out=True)
    p.write(f"ret i1 {last.text}")


def evaluate_states(p: LlvmPrinter, spec: KernelSpec, lanes: int, element: str, own: bool) -> None:
    """Write evaluations of states (assets, size) as they are, one asset after the other, to `out` (assets, row)."""
    block, size = LaneBlock(p, spec, 1, element), spec.sizes
    for asset in p.loop(0, p.argument("assets")):
        c = Memory(p, p.place(element, "%constants", asset * p.argument("constant_step")), element)
        block.copy_states("%state", [asset * (HEADER_SIZE + size.floats + size.watched + size.extra)], out=False)
        block.evaluate(c, Memory(p, p.place(element, "%out", asset * size.row), element))


def write_regressors(p: LlvmPrinter, spec: KernelSpec, lanes: int, element: str, own: bool) -> None:
    """Write [eta, phi, z] of every sample of one asset to `out` (N, rows), and its status to `status` (N,).

    The state is carried on in place.
    """
    block, size, zero = LaneBlock(p, spec, 1, element), spec.sizes, Int(p, "0")
    c, samples, stride = Memory(p, "%constants", element), p.argument("samples"), p.argument("stride")
    block.copy_states("%state", [zero], out=False)
    number = p.truncate(Float(p, block.h.load(SAMPLE), "double"))
    for k in p.loop(0, samples):
        for row, name in enumerate(("%r", "%u", "%y")):
            block.tile.store(row * TILE, p.load(element, p.place(element, name, k)))
        flag = p.load("i8", p.place("i8", "%restart", k))
        block.tile.store(3 * TILE, p.assign(f"uitofp i8 {flag} to {element}"))
        block.filter_sample(c, 0, ((number + k + 1) % stride).is_equal(0))
        status = Float(p, block.status.load(0), "double")
        place = p.place("i64", "%status", k)
        p.store("i64", str(p.truncate(status)), place)
        with p.when(status > MISSING):
            for i in range(size.rows):
                p.store(element, block.v.load(i), p.place(element, "%out", k * size.rows + i))
    block.copy_states("%state", [zero], out=True)


FUNCTIONS = {
    "run_blocks": (run_blocks, BLOCKS, "void"),
    "run_sample": (run_sample, SINGLE, "i1"),
    "evaluate_states": (evaluate_states, EVALUATION, "void"),
    "write_regressors": (write_regressors, REGRESSORS, "void"),
}


@functools.cache
def compile_function(name: str, spec: KernelSpec, lanes: int = 1, single: bool = False, own: bool = False) -> Any:
    """Return one of the `FUNCTIONS` for a specification; pointers are given as addresses.

    `own` says whether each lane has constants of its own.
    """
    write, arguments, result = FUNCTIONS[name]
    printer = LlvmPrinter(arguments, result)
    write(printer, spec, lanes, "float" if single else "double", own)
    if result == "void":
        printer.write("ret void")
    is_step = name == "run_sample"  # one sample at a time, for which all optimisation pays
    return native_function(printer.text(), arguments, result, brief=is_step, straight=not is_step)
