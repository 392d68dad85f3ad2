"""One loop's chain of bank and recursion as constants: a recording -> regressors, estimates; no faults here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from servoscope import inverse
from servoscope.errors import LoopError
from servoscope.inverse import FilterBank
from servoscope.linear import Linear
from servoscope.noise import Coloured
from servoscope.plants import EXTRAS, FloatArray
from servoscope.recording import Recording
from servoscope.twostage import Stage, StageOne
from servoscope.valve import Valve, held_back

if TYPE_CHECKING:
    from servoscope.cusum import Watch
    from servoscope.loop import Loop
    from servoscope.recursion import BoolArray, Constants, IntArray, Recursion, View


@dataclass(frozen=True, eq=False)
class Tuning:
    """What a baseline knows of one loop's recursion, in physical units.

    Parameters
    ----------
    theta
        Healthy coefficients, where the recursion starts, shape (n,).
    scale
        Typical size (rms) of each column of phi on healthy data, shape (n,).
    P_d
        Desired covariance of the AKF, shape (n, n).
    R
        Variance of the residual v.
    noise
        Model of v.
    """

    theta: FloatArray
    scale: FloatArray
    P_d: FloatArray
    R: float
    noise: Coloured


@dataclass(frozen=True, eq=False)
class Regression:
    """eta, phi and z of every sample.

    Parameters
    ----------
    eta
        Shape (N,).
    phi, z
        Shape (N, n); z is phi where there is no instrument.
    ok
        Whether the sample may update an estimator, shape (N,).
    """

    eta: FloatArray
    phi: FloatArray
    z: FloatArray
    ok: BoolArray


@dataclass(frozen=True, eq=False)
class Estimates:
    """What the recursion says, one row per evaluation.

    Parameters
    ----------
    index
        Sample of the evaluation, shape (K,).
    updates, skipped
        Updates so far, and those that a guard refused, shape (K,).
    power
        Recent mean square of the residual relative to the baseline's, shape (K,).
    level
        Largest CUSUM since the evaluation before, as a multiple of its limit, shape (K,).
    crossed
        Sample at which one first passed its limit, counted from 1; 0 where none has, shape (K,).
    theta
        Estimate, shape (K, n).
    S
        Its covariance under the recording's own excitation, shape (K, n, n).
    Psi
        Share of the starting value that is left in it, shape (K, n, n).
    """

    index: IntArray
    updates: FloatArray
    skipped: FloatArray
    power: FloatArray
    level: FloatArray
    crossed: FloatArray
    theta: FloatArray
    S: FloatArray
    Psi: FloatArray


@dataclass(frozen=True, eq=False)
class Pipeline:
    """A loop, its filter bank, stage 1 if it has one, and the speed of standing still; build it with `of`."""

    loop: Loop
    bank: FilterBank
    stage_one: StageOne | None = None
    still_speed: float = 0.0

    @classmethod
    def of(cls, loop: Loop, stage_one: StageOne | None = None, still_speed: float = 0.0) -> Pipeline:
        """Turn a loop's settings into constant matrices.

        Parameters
        ----------
        loop
            The loop.
        stage_one
            What `servoscope.twostage.tune` found; needed with ``two_stage = "adaptive"``.
        still_speed
            Speed below which the axis stands still; the estimator is held once it has done so for longer than the
            filters remember. 0: never.

        Raises
        ------
        LoopError
            If the structure does not suit the plant, the estimator needs an instrument and the loop has neither a
            controller nor nominal values to make one of, or stage 1 is demanded and not tuned or goes with a valve law.
        """
        from servoscope import estimators

        if loop.monitor.two_stage != "none" and stage_one is None:
            raise LoopError(f"{loop.name}: [monitor] two_stage = 'adaptive' needs a tuned stage 1: learn a baseline")
        if loop.monitor.two_stage != "none" and Valve(loop).size:
            raise LoopError(
                f"{loop.name}: [monitor] two_stage = 'adaptive' simulates u from r as if the valve were linear: "
                "set [plant] valve_law = 'linear' or two_stage = 'none'"
            )
        needs = estimators.load(loop.monitor.estimator).NEEDS_INSTRUMENT
        bank = inverse.build(loop, inverse.instrument_of(loop) if needs else None)
        return cls(loop, bank, stage_one if loop.monitor.two_stage != "none" else None, still_speed)

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
        """Samples between updates: 1 up to 20 times the cutoff; beyond, neighbours in a filtered signal are alike.

        Their noise would be so nearly a polynomial in time that no autoregression of it can be solved for.
        """
        if self.bank.structure != "svf":
            return 1
        return max(1, int(self.loop.sample_rate / (10.0 * inverse.cutoff_of(self.loop))))

    @property
    def memory(self) -> float:
        """Memory N of the estimator in updates."""
        return self.loop.monitor.memory * self.loop.sample_rate / self.stride

    def constants(
        self, tuning: Tuning, watch: Watch | None = None, view: View | None = None, *, steady: bool = True
    ) -> Constants:
        """Turn loop and tuning into what the compiled recursion takes.

        Parameters
        ----------
        tuning
            Of the baseline.
        watch
            The sequential test; without it there is none.
        view
            What complete evaluations take; without it there are only those that a diagnosis takes.
        steady
            Whether P begins at P_d, so that an estimator that leaves it there needs none.
        """
        from servoscope import estimators
        from servoscope.recursion import Constants

        loop, bank, name = self.loop, self.bank, self.loop.monitor.estimator
        steady = steady and hasattr(estimators.load(name), "steady")
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
        dead = loop.input_deadzone or (np.inf, -np.inf)
        unlimited = loop.input_logged == "after_limiter" or self.valve.size  # a valve law limits u itself
        lags, heads = tuning.noise.chain()
        return Constants(
            estimator=name,
            steady=steady,
            bank=self._behind_valve.output(rows),
            velocity=bank.velocity,
            v_of_r=bank.velocity_of_reference,
            codes=tuple(EXTRAS.index(extra) for extra in bank.extras),
            limits=(-np.inf, np.inf) if unlimited else (loop.input_limits or (-np.inf, np.inf)),
            deadzone=dead,
            sign_speed=float(getattr(loop.plant, "sign_speed", 0.0)),
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
            extra=estimators.extra(name, bank.n, self.memory),
            watch=watch,
            view=view,
        )

    def blank(self) -> Tuning:
        """Return a tuning that only serves to form regressors: scale 1, nothing known of noise."""
        n = self.bank.n
        noise = Coloured(np.zeros(1), np.zeros(0), np.ones(1), 1.0)
        return Tuning(np.zeros(n), np.ones(n), np.eye(n), 1.0, noise)

    def input(self, r: FloatArray, u: FloatArray, restart: BoolArray) -> FloatArray:
        """Return what takes the place of u in eta, shape (N,): u_a of stage 1, or u itself without one."""
        stage = Stage(self.loop, self.stage_one)
        return stage.run(stage.start(), r, u, restart)

    @cached_property
    def valve(self) -> Valve:
        """The law of the valve, in front of everything; it lets u pass where the law is linear."""
        return Valve(self.loop)

    @cached_property
    def _behind_valve(self) -> Linear:
        """The bank without the delay that the valve law takes over."""
        if not held_back(self.loop):
            return self.bank.system
        instrument = inverse.instrument_of(self.loop) if self.bank.has_instrument else None
        rest = self.loop.model_copy(update={"delay": self.loop.delay - held_back(self.loop)})
        return inverse.build(rest, instrument).system

    def flow(self, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return what the valve makes of u, shape (N,); u itself where its law is linear."""
        return self.valve.run(self.valve.start(), u, y, restart)

    @cached_property
    def _plain(self) -> Recursion:
        """The recursion that only forms regressors: asked for again and again while signatures are drawn."""
        from servoscope.recursion import Recursion

        return Recursion([self.constants(self.blank())])

    def regression(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> Regression:
        """Form eta, phi and z of a block, each input of shape (N,); phi and z in physical units."""
        return Regressing(self).advance(r, u, y, restart)

    def estimate(self, tuning: Tuning, recording: Recording, watch: Watch | None = None) -> Estimates:
        """Run the recursion over a recording, from the tuning's theta, with or without the sequential test."""
        return Estimating(self, tuning, watch).advance(recording)

    def unpack(self, c: Constants, rows: FloatArray, index: IntArray) -> Estimates:
        """Turn rows of a recursion, shape (K, row), into estimates in physical units."""
        n, basis = self.bank.n, c.basis
        theta, S, Psi = np.split(rows[:, 5:], [n, n + n * n], axis=1)
        # basis S basis' and basis Psi/basis, row by row of many evaluations at a time
        both, from_left = np.kron(basis, basis), np.kron(basis, np.linalg.inv(basis).T)
        return Estimates(
            index=index,
            updates=rows[:, 0],
            skipped=rows[:, 1],
            power=rows[:, 2] / c.variance,
            level=rows[:, 3],
            crossed=rows[:, 4],
            theta=c.origin + theta @ basis.T,
            S=(S @ both.T).reshape(-1, n, n),
            Psi=(Psi @ from_left.T).reshape(-1, n, n),
        )


class Regressing:
    """Forms eta, phi and z block by block; where a recording is cut changes nothing."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline, self._ahead = pipeline, _Ahead(pipeline)
        self._state = pipeline._plain.start()[0]

    def advance(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> Regression:
        """Return the regression of the next block, each input of shape (N,)."""
        bank = self._pipeline.bank
        out, ok = self._pipeline._plain.regressors(self._state, r, self._ahead.input(r, u, y, restart), y, restart)
        phi = out[:, 1 : 1 + bank.n].copy()
        return Regression(out[:, 0], phi, out[:, -bank.n :].copy() if bank.has_instrument else phi, ok == 1)


class Estimating:
    """Runs the recursion block by block, from the tuning's theta; where a recording is cut changes nothing."""

    def __init__(self, pipeline: Pipeline, tuning: Tuning, watch: Watch | None = None) -> None:
        from servoscope.recursion import Recursion

        self._pipeline, self._ahead = pipeline, _Ahead(pipeline)
        self._constants = pipeline.constants(tuning, watch)
        self._recursion = Recursion([self._constants])
        self._state = self._recursion.start()

    def advance(self, block: Recording) -> Estimates:
        """Return the estimates of the next block; their samples count from the first block on."""
        r, y, restart = block.r, block.y, block.restart
        u = self._ahead.input(r, block.u, y, restart)
        index = self._recursion.rows(self._state, block.samples)
        self._state, out = self._recursion.run(self._state, r[None], u[None], y[None], restart[None])
        return self._pipeline.unpack(self._constants, out[0], index)


class _Ahead:
    """What stands before bank and recursion: the valve's law and stage 1, with their states."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._valve, self._stage = pipeline.valve, Stage(pipeline.loop, pipeline.stage_one)
        self._of_valve, self._of_stage = self._valve.start(), self._stage.start()

    def input(self, r: FloatArray, u: FloatArray, y: FloatArray, restart: BoolArray) -> FloatArray:
        """Return what takes the place of u in the next block, shape (N,)."""
        flow = self._valve.run(self._of_valve, u, y, restart)
        return self._stage.run(self._of_stage, r, flow, restart)
