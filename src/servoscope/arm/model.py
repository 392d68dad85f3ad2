"""Joint torques of an arm as a linear regression on base parameters, friction, rotor inertia and offset.

    K_j i_j = Y_j(q, v, a) pi + F_vj v_j + F_cj s(v_j) + F_lj abs(g_j(q)) s(v_j) + F_bj c(v_j) + I_aj a_j + b_j,
    s(v) = tanh(v/v0),   c(v) = tanh(v/v1) without its straight part

Friction is no straight line over the speed, and what a joint's torque needs to turn round lags behind its position:
on a UR10e both together lower what is left of a joint's torque by 16 to 36 %.

Only base parameters, linear combinations of the ten parameters per link and the rotor inertias, show in torques
(Gautier, Numerical calculation of the base inertial parameters of robots, 1991): pivoted QR finds them from random
motion.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from servoscope.arm.dynamics import LINK_PARAMETERS, torque_regressor
from servoscope.arm.settings import ArmLoop
from servoscope.arm.urdf import Kinematics
from servoscope.core.arrays import FloatArray, IndexArray

RANK_TOLERANCE = 1e-8  # of the largest diagonal entry of R, below which a parameter depends on others
RANDOM_SAMPLES = 40  # of random motion, from which the base parameters are found
MAX_NAME_TERMS = 3  # of a base parameter's name
# size of a link's parameters for each kg of it, as far as they are uncertain: m; m c [m]; inertia [m^2]
LINK_SIZES = (1.0, *(0.3,) * 3, *(0.1,) * 6)
ROTOR_SIZE = 5.0  # kg m^2 behind the gear
FRICTION = ("viscous_friction", "coulomb_friction", "load_friction")
CURVE_SPAN = 3.0  # times `curve_speed`, up to which a curve of friction has no straight part


class BaseParameters(NamedTuple):
    """Which parameters are regressed, and what they stand for.

    `chosen`: indices (p,) among the ten per link and the rotor inertias; `names`: with what is added to each;
    `nominal, size`: by the URDF, and how uncertain that is, (p,).
    """

    chosen: tuple[int, ...]
    names: tuple[str, ...]
    nominal: FloatArray
    size: FloatArray


class ArmModel:
    """An arm with its loop file: columns of the regression and what they are called."""

    def __init__(self, arm: Kinematics, loop: ArmLoop) -> None:
        self.arm, self.loop, self.gears = arm, loop, loop.gear_matrix(arm)
        self.gains = np.array([joint.gain for joint in loop.columns_of(arm)])
        # motors that turn with several joints, scaled to the largest of them
        coupled = self.gears[(self.gears != 0.0).sum(1) > 1]
        self.coupled = coupled / np.abs(coupled).max(1, keepdims=True)

    @cached_property
    def base(self) -> BaseParameters:
        """The base parameters."""
        from scipy.linalg import qr, solve_triangular

        n, rng = self.arm.size, np.random.default_rng(0)
        Y = self._inertial_columns(*(rng.normal(size=(RANDOM_SAMPLES, n)) for _ in range(3)))
        R, order = qr(Y.transpose(0, 2, 1).reshape(-1, Y.shape[1]), mode="r", pivoting=True)
        rank = int((np.abs(np.diag(R)) > RANK_TOLERANCE * abs(R[0, 0])).sum())
        added = solve_triangular(R[:rank, :rank], R[:rank, rank:])  # what the others add to those that are chosen
        names = [f"{name}.{what}" for name in self.arm.names for what in LINK_PARAMETERS]
        names += [f"{name}.rotor" for name in self.arm.names]
        names += [f"motor{index + 1}.rotor" for index in range(len(self.coupled))]
        rotors = n + len(self.coupled)
        nominal = np.concatenate([self.arm.inertial.ravel(), np.zeros(rotors)])
        size = np.concatenate([np.outer(self.arm.inertial[:, 0], LINK_SIZES).ravel(), np.full(rotors, ROTOR_SIZE)])
        # in the order of the links
        rows = np.argsort(order[:rank])
        chosen, others = order[:rank][rows], order[rank:]
        sums: FloatArray = np.asarray(added)[rows]
        return BaseParameters(
            tuple(chosen.tolist()),
            tuple(
                _base_name(names[index], row, [names[i] for i in others])
                for index, row in zip(chosen.tolist(), list(sums), strict=True)
            ),
            nominal[chosen] + sums @ nominal[others],
            np.hypot(size[chosen], np.linalg.norm(sums * size[others], axis=1)),
        )

    def _inertial_columns(self, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        """Return the columns of links and rotors, (n, 10 n + n + c, N)."""
        rotors = [_own_row(j, a[:, j], self.arm.size) for j in range(self.arm.size)]
        rotors += [row[:, None] * (a @ row) for row in self.coupled]
        return np.concatenate([torque_regressor(self.arm, q, v, a, self.loop.gravity), _stack(rotors)], axis=1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns of `columns`."""
        own = [
            f"{joint}.{what}" for joint in self.arm.names for what in ("viscous_friction", "coulomb_friction", "offset")
        ]
        motors = [
            f"motor{index + 1}.{what}"
            for index in range(len(self.coupled))
            for what in ("viscous_friction", "coulomb_friction")
        ]
        curves = [f"{joint}.friction_curve" for joint in self.arm.names] if self.loop.curve_speed else []
        return (*self.base.names, *own, *motors, *curves)

    @property
    def friction_columns(self) -> IndexArray:
        """Which columns hold viscous and Coulomb friction of each joint, (n, 2)."""
        return np.asarray(len(self.base.names) + 3 * np.arange(self.arm.size)[:, None] + np.arange(2))

    def columns(self, q: FloatArray, v: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the columns of the regression, (n, P, N), and those of a mass at the last joint, (n, 4, N).

        `q, v, a`: position, velocity, acceleration of the joints, (N, n).
        """
        n, v0 = self.arm.size, self.loop.sign_speed
        whole = self._inertial_columns(q, v, a)
        friction = []
        for j in range(n):
            friction += [_own_row(j, x, n) for x in (v[:, j], np.tanh(v[:, j] / v0), np.ones(len(v)))]
        for row in self.coupled:
            friction += [row[:, None] * x for x in (v @ row, np.tanh(v @ row / v0))]
        if self.loop.curve_speed:
            friction += [_own_row(j, self._friction_curve(v[:, j]), n) for j in range(n)]
        inertial = whole[:, list(self.base.chosen)]
        return np.concatenate([inertial, _stack(friction)], axis=1), whole[:, 10 * n - 10 : 10 * n - 6]

    def _friction_curve(self, v: FloatArray) -> FloatArray:
        """Return tanh(v/v1) without the straight line through it, which Coulomb and viscous friction are, (N,)."""
        x = np.linspace(0.0, CURVE_SPAN, 100)
        coulomb, viscous = np.linalg.lstsq(np.column_stack([np.ones(x.size), x]), np.tanh(x))[0]
        v = v / self.loop.curve_speed
        sign = np.tanh(v * (self.loop.curve_speed / self.loop.sign_speed))
        return np.asarray(np.tanh(v) - coulomb * sign - viscous * v)

    def inertial_torque(self, q: FloatArray, v: FloatArray, a: FloatArray, base: FloatArray) -> FloatArray:
        """Return the torques of base parameters (p,) alone, (n, N)."""
        columns = self._inertial_columns(q, v, a)[:, list(self.base.chosen)]
        return np.asarray(np.einsum("jpn,p->jn", columns, base))


def _own_row(j: int, x: FloatArray, n: int) -> FloatArray:
    """Return a column that only joint j has, (n, N)."""
    column = np.zeros((n, x.size))
    column[j] = x
    return column


def _stack(columns: list[FloatArray]) -> FloatArray:
    return np.stack(columns, axis=1)


def _base_name(name: str, row: FloatArray, others: list[str]) -> str:
    terms = [(factor, other) for factor, other in zip(row, others, strict=True) if abs(factor) > 1e-6]
    texts = [f" {'-' if factor < 0.0 else '+'} {abs(factor):.3g} {other}" for factor, other in terms[:MAX_NAME_TERMS]]
    return name + "".join(texts) + (" + ..." if len(terms) > MAX_NAME_TERMS else "")
