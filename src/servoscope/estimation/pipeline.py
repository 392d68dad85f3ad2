"""One loop's filter bank and recursion: from a recording to regressors and estimates."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import numpy as np

from servoscope.core.arrays import BoolArray, FloatArray, IntArray
from servoscope.core.errors import LoopError
from servoscope.estimation import estimators, filter_bank
from servoscope.estimation.filter_bank import FilterBank
from servoscope.estimation.instrument import InstrumentTuning, instrument_model
from servoscope.estimation.kernel.cusum import CusumConstants
from servoscope.estimation.moments import add_products
from servoscope.estimation.noise_model import ArmaNoise, WhiteNoise
from servoscope.estimation.recursion import EvaluationConstants, Recursion, RecursionConstants
from servoscope.estimation.two_stage import StageOneRunner, StageOneTuning
from servoscope.estimation.valve import ValveLaw, integer_delay
from servoscope.models.loop import Loop
from servoscope.models.lti import LinearSystem
from servoscope.models.plants.polynomial import PolynomialPlant
from servoscope.signals import Recording


@dataclass(frozen=True, eq=False)
class Tuning:
    """The tuning of one loop's recursion, from a baseline, in physical units."""

    theta: FloatArray  # healthy coefficients, where the recursion starts, shape (n,)
    scale: FloatArray  # typical size (rms) of each column of phi on healthy data, shape (n,)
    P_d: FloatArray  # desired covariance of the AKF, shape (n, n)
    R: float  # variance of the residual v
    noise: ArmaNoise  # model of v


@dataclass(frozen=True, eq=False)
class Regression:
    """eta, phi and z of every sample."""

    eta: FloatArray  # shape (N,)
    phi: FloatArray  # phi, z: shape (N, n); z is phi where there is no instrument
    z: FloatArray
    ok: BoolArray  # whether the sample may update an estimator, shape (N,)

    @property
    def halves(self) -> tuple[Regression, Regression]:
        """The first and the second half of the samples."""
        middle = len(self.eta) // 2
        return self.rows(slice(middle)), self.rows(slice(middle, None))

    def rows(self, rows: slice) -> Regression:
        """Return some of the samples."""
        return Regression(self.eta[rows], self.phi[rows], self.z[rows], self.ok[rows])


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates of the recursion, one row per evaluation."""

    index: IntArray  # sample of the evaluation, shape (K,)
    updates: FloatArray  # updates, skipped: updates so far, and those that a guard refused, shape (K,)
    skipped: FloatArray
    power: FloatArray  # recent mean square of the residual relative to the baseline's, shape (K,)
    level: FloatArray  # largest CUSUM since the evaluation before, as a multiple of its limit, shape (K,)
    crossed: FloatArray  # sample at which one first passed its limit, counted from 1; 0 where none has, shape (K,)
    theta: FloatArray  # estimate, shape (K, n)
    S: FloatArray  # its covariance under the recording's own excitation, shape (K, n, n)
    Psi: FloatArray  # share of the starting value that is left in it, shape (K, n, n)

    @property
    def skipped_share(self) -> float:
        """The share of all updates that a guard refused."""
        skipped, updated = self.skipped[-1:].sum(), self.updates[-1:].sum()
        return float(skipped / max(skipped + updated, 1.0))


class InputStage:
    """The valve's law and stage 1, which come before the bank; their states are one array (size,)."""

    def __init__(self, loop: Loop, stage_one: StageOneTuning | None) -> None:
        self.valve, self._stage = ValveLaw(loop), StageOneRunner(loop, stage_one)
        self.size = self.valve.size + self._stage.size

    def start(self) -> FloatArray:
        """Return the state before the first sample, shape (size,)."""
        return np.concatenate([self.valve.start(), self._stage.start()])

    def run(self, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return the input of the bank for the next block, shape (N,), and change `state` in place."""
        flow = self.valve.run(state[: self.valve.size], u, y, restart)
        return self._stage.run(state[self.valve.size : self.size], r, flow, restart)


@dataclass(frozen=True, eq=False)
class Pipeline:
    """A loop, its filter bank, stage 1 if it has one, and the speed below which it rests; build it with `of`."""

    loop: Loop
    bank: FilterBank
    stage_one: StageOneTuning | None = None
    still_speed: float = 0.0
    instrument: InstrumentTuning | None = None

    @classmethod
    def of(
        cls,
        loop: Loop,
        stage_one: StageOneTuning | None = None,
        still_speed: float = 0.0,
        instrument: InstrumentTuning | None = None,
    ) -> Pipeline:
        """Turn a loop's settings into constant matrices.

        A loop with ``two_stage = "adaptive"`` needs a tuning of stage 1. The estimator is held once the axis has been
        slower than `still_speed` for longer than the filters remember. An estimator that needs an instrument takes the
        learned one, or that of the nominal closed loop. Raises LoopError if the structure does not suit the plant, the
        instrument cannot be made, stage 1 is missing, or it meets a valve law.
        """
        if loop.monitor.two_stage != "none" and stage_one is None:
            raise LoopError(f"{loop.name}: [monitor] two_stage = 'adaptive' needs a tuned stage 1: learn a baseline")
        if loop.monitor.two_stage != "none" and ValveLaw(loop).size:
            raise LoopError(
                f"{loop.name}: [monitor] two_stage = 'adaptive' simulates u from r as if the valve were linear: "
                "set [plant] valve_law = 'linear' or two_stage = 'none'"
            )
        needs = estimators.load_estimator(loop.monitor.estimator).NEEDS_INSTRUMENT
        bank = filter_bank.build_filter_bank(loop, instrument_model(loop, instrument) if needs else None)
        stage = stage_one if loop.monitor.two_stage != "none" else None
        return cls(loop, bank, stage, still_speed, instrument if needs else None)

    @property
    def every(self) -> int:
        """Samples between evaluations."""
        return max(1, round(self.loop.sample_rate / self.loop.monitor.evaluation_rate))

    @property
    def delays(self) -> tuple[int, int]:
        """On-delay and off-delay of the alarm, in evaluations."""
        monitor = self.loop.monitor
        off = monitor.memory if monitor.off_delay is None else monitor.off_delay
        rate = self.loop.sample_rate / self.every
        return round(monitor.on_delay * rate), round(off * rate)

    @property
    def stride(self) -> int:
        """Samples between updates: 1 up to 20 times the cutoff.

        Beyond, the noise is so nearly a polynomial in time that no autoregression of it can be solved for.
        """
        if self.bank.structure != "svf":
            return 1
        return max(1, int(self.loop.sample_rate / (10.0 * self.loop.cutoff)))

    @property
    def memory(self) -> float:
        """Memory N of the estimator in updates."""
        return self.memory_samples / self.stride

    @property
    def cusum_updates(self) -> int:
        """Updates that a step of the sequential test takes together."""
        return max(self.every // self.stride, 1) if self.loop.monitor.sequential_step == "evaluation" else 1

    @property
    def memory_samples(self) -> float:
        """Memory of the estimator in samples."""
        return self.loop.monitor.memory * self.loop.sample_rate

    def constants(
        self,
        tuning: Tuning,
        watch: CusumConstants | None = None,
        view: EvaluationConstants | None = None,
        *,
        steady: bool = True,
    ) -> RecursionConstants:
        """Turn loop and tuning into the constants of the recursion.

        `watch` is the sequential test, if there is one. Without `view` there are only the evaluations that a diagnosis
        takes. `steady` says that P begins at P_d, so that an estimator that leaves it there needs none.
        """
        loop, bank, name = self.loop, self.bank, self.loop.monitor.estimator
        steady = steady and hasattr(estimators.load_estimator(name), "steady_gain")
        # phi times this has P_d = I; the scale keeps Cholesky's factor from mixing units
        pairs = np.outer(tuning.scale, tuning.scale)
        basis = np.diag(1.0 / tuning.scale)
        if steady:
            basis = basis @ np.linalg.cholesky(tuning.P_d * pairs)
        back = np.linalg.inv(basis)
        theta = np.asarray(back @ tuning.theta, dtype=np.float64)
        rows = np.eye(len(self._behind_valve.C))
        rows[1 : 1 + bank.n, 1 : 1 + bank.n] = basis.T
        if bank.has_instrument:
            rows[1 + bank.n :, 1 + bank.n :] = basis.T
        rows[0] -= theta @ rows[1 : 1 + bank.n]
        edges = np.array([loop.input_deadzone or (np.inf, -np.inf), loop.input_limits or (-np.inf, np.inf)])
        dead, limits = map(tuple, loop.plant.effective_input(edges).tolist())
        unlimited = loop.input_logged == "after_limiter" or self.ahead.valve.size  # a valve law limits u itself
        lags, heads = tuning.noise.chain()
        return RecursionConstants(
            estimator=name,
            steady=steady,
            bank=self._behind_valve.output(rows),
            velocity=bank.velocity,
            v_of_r=bank.velocity_of_reference,
            nonlinear=bank.extras,
            shapes=tuple(x for extra in bank.extras for x in loop.plant.column_shapes.get(extra, ())),
            limits=(-np.inf, np.inf) if unlimited else limits,
            deadzone=dead,
            sign_speed=loop.plant.velocity_sign.dead_speed,
            rest_speed=loop.monitor.rest_speed,
            still_speed=self.still_speed,
            only_moving=loop.monitor.update_when == "moving",
            wait=bank.wait,
            stride=self.stride,
            every=self.every,
            scale=tuning.scale,
            basis=basis,
            theta=theta,
            origin=tuning.theta,
            P_d=back @ tuning.P_d @ back.T,
            R=tuning.R,
            a=lags,
            heads=heads,
            variance=float(tuning.noise.gamma[0]),
            memory=self.memory,
            extra=estimators.extra_state_size(name, bank.n, self.memory),
            watch=watch,
            view=view,
        )

    def blank(self) -> Tuning:
        """Return a tuning that only serves to form regressors: scale 1, unit noise."""
        n = self.bank.n
        noise = ArmaNoise(np.zeros(1), np.zeros(0), np.ones(1), 1.0)
        return Tuning(np.zeros(n), np.ones(n), np.eye(n), 1.0, noise)

    def input(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return the input of the regression, shape (N,): flow of the valve, u_a of stage 1, or u itself."""
        return self.ahead.run(self.ahead.start(), r, u, y, restart)

    @cached_property
    def ahead(self) -> InputStage:
        """What u passes before the bank."""
        return InputStage(self.loop, self.stage_one)

    @cached_property
    def _behind_valve(self) -> LinearSystem:
        """The bank without the delay that the valve law takes over."""
        if not integer_delay(self.loop):
            return self.bank.system
        instrument = instrument_model(self.loop, self.instrument) if self.bank.has_instrument else None
        inner = self.loop.model_copy(update={"delay": self.loop.delay - integer_delay(self.loop)})
        return filter_bank.build_filter_bank(inner, instrument).system

    @cached_property
    def kinematics(self) -> Pipeline:
        """What forms position, speed and acceleration of a signal behind a filter with the loop's cutoff."""
        loop = self.loop
        plain = {"structure": "svf", "cutoff": loop.cutoff, "estimator": "akf", "two_stage": "none"}
        update = {
            "plant": PolynomialPlant(order=2, stiffness=True),
            "monitor": loop.monitor.model_copy(update=plain),
            "input_deadzone": None,
            "delay": 0.0,
        }
        return Pipeline.of(loop.model_copy(update=update))

    @cached_property
    def noise_models(self) -> dict[tuple[str, WhiteNoise], ArmaNoise]:
        """Models of v by plant (as JSON) and noise; see `servoscope.baseline.expectation.residual_noise_model`."""
        return {}

    @cached_property
    def _plain(self) -> Recursion:
        """The recursion that only forms regressors; cached, for signatures need it many times."""
        return Recursion([self.constants(self.blank())])

    def regression(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> Regression:
        """Form eta, phi and z of a block, each input of shape (N,); phi and z in physical units."""
        return RegressionRunner(self).advance(r, u, y, restart)

    def estimate(self, tuning: Tuning, recording: Recording, watch: CusumConstants | None = None) -> Estimates:
        """Run the recursion over a recording, from the tuning's theta, with or without the sequential test."""
        return EstimationRunner(self, tuning, watch).advance(recording)

    def unpack(self, c: RecursionConstants, rows: FloatArray, index: IntArray) -> Estimates:
        """Turn rows of a recursion, shape (K, row), into estimates in physical units."""
        n, basis = self.bank.n, c.basis
        theta, S, Psi = rows[:, 5 : 5 + n], rows[:, 5 + n : 5 + n + n * n], rows[:, 5 + n + n * n :]
        both, back = _products(n, basis.tobytes())
        return Estimates(
            index=index,
            updates=rows[:, 0],
            skipped=rows[:, 1],
            power=rows[:, 2] / c.variance,
            level=rows[:, 3],
            crossed=rows[:, 4],
            theta=c.origin + _transform_rows(theta, _elements(basis)),
            S=_transform_rows(S, both).reshape(-1, n, n),
            Psi=_transform_rows(Psi, back).reshape(-1, n, n),
        )


class _Elements(NamedTuple):
    """The elements of a matrix (p, m) that are not 0: their rows, columns and values."""

    p: int
    rows: IntArray
    columns: IntArray
    values: FloatArray


def _elements(matrix: FloatArray) -> _Elements:
    rows, columns = np.nonzero(matrix)
    return _Elements(len(matrix), rows, columns, matrix[rows, columns])


@lru_cache(1024)  # a baseline asks for its own with each recording
def _products(n: int, basis: bytes) -> tuple[_Elements, _Elements]:
    """Return basis S basis' and basis Psi/basis, each as a product with the elements of S or Psi in one row."""
    own = np.frombuffer(basis).reshape(n, n)
    both, back = (np.asarray(np.kron(own, other)) for other in (own, np.linalg.inv(own).T))
    return _elements(both), _elements(back)


def _transform_rows(rows: FloatArray, matrix: _Elements) -> FloatArray:
    """Return a matrix (p, m) times each of K rows, shape (K, p); a row's bits do not depend on the others."""
    transformed = np.zeros((matrix.p, len(rows)))
    add_products(*matrix[1:], np.ascontiguousarray(rows.T, dtype=np.float64), transformed)
    return np.ascontiguousarray(transformed.T)


class RegressionRunner:
    """Forms eta, phi and z block by block; the result does not depend on where a recording is cut.

    Its `state` is one array, changed in place; one that is given is gone on with.
    """

    def __init__(self, pipeline: Pipeline, state: FloatArray | None = None) -> None:
        self._pipeline, size = pipeline, pipeline.ahead.size
        self.state = np.concatenate([pipeline.ahead.start(), pipeline._plain.start()[0]]) if state is None else state
        self._ahead, self._state = self.state[:size], self.state[size:]

    def advance(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> Regression:
        """Return the regression of the next block, each input of shape (N,)."""
        bank, u = self._pipeline.bank, self._pipeline.ahead.run(self._ahead, r, u, y, restart)
        out, ok = self._pipeline._plain.regressors(self._state, r, u, y, restart)
        phi = out[:, 1 : 1 + bank.n].copy()
        return Regression(out[:, 0], phi, out[:, -bank.n :].copy() if bank.has_instrument else phi, ok == 1)


class EstimationRunner:
    """Runs the recursion block by block, from the tuning's theta, to the same result wherever a recording is cut."""

    def __init__(self, pipeline: Pipeline, tuning: Tuning, watch: CusumConstants | None = None) -> None:
        self._pipeline, self._ahead = pipeline, pipeline.ahead.start()
        self._constants = pipeline.constants(tuning, watch)
        self._recursion = Recursion([self._constants])
        self._state = self._recursion.start()

    def again(self) -> Self:
        """Return one at the first sample, whose constants are these."""
        other = copy.copy(self)
        other._ahead, other._state = self._pipeline.ahead.start(), self._recursion.start()
        return other

    def advance(self, block: Recording) -> Estimates:
        """Return the estimates of the next block; their samples count from the first block on."""
        r, y, restart = block.r, block.y, block.restart
        u = self._pipeline.ahead.run(self._ahead, r, block.u, y, restart)
        index = self._recursion.rows(self._state, block.samples)
        self._state, out = self._recursion.run(self._state, r[None], u[None], y[None], restart[None])
        return self._pipeline.unpack(self._constants, out[0], index)
