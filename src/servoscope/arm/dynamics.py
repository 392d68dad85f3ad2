"""Joint torques of an arm, linear in the inertial parameters of its links: Newton and Euler, vectorised over samples.

tau_j = z_j . (n_i + (p_i - p_j) x f_i), summed over the links i that joint j carries, where force f_i and moment n_i
about the frame of link i are linear in its ten parameters (Khalil and Dombre, Modeling, Identification and Control of
Robots, 2002, section 9.6). Each link's terms are expressed in its own frame, component by component, so that all
arithmetic runs along the samples.
"""

from __future__ import annotations

import numpy as np

from servoscope.arm.urdf import Kinematics
from servoscope.core.arrays import FloatArray

STANDARD_GRAVITY = (0.0, 0.0, -9.80665)  # m/s^2, in the frame of the base
SAMPLES_PER_PIECE = 2048  # so that the components of all joints stay in the cache
LINK_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")


def torque_regressor(
    arm: Kinematics,
    q: FloatArray,
    v: FloatArray,
    a: FloatArray,
    gravity: tuple[float, float, float] = STANDARD_GRAVITY,
) -> FloatArray:
    """Return Y with tau_j = sum_k Y[j, k] pi_k, shape (n, 10 n, N); pi lists ten parameters per link.

    `q, v, a`: position, velocity and acceleration of the joints [rad or m, s], shape (N, n); `gravity`: [m/s^2] in the
    frame of the base.
    """
    n, N = arm.size, q.shape[0]
    Y = np.zeros((n, 10 * n, N))
    for first in range(0, N, SAMPLES_PER_PIECE):
        rows = slice(first, min(first + SAMPLES_PER_PIECE, N))
        _fill(arm, np.ascontiguousarray(q[rows].T), v[rows].T, a[rows].T, gravity, Y[:, :, rows])
    return Y


def _fill(
    arm: Kinematics, q: FloatArray, v: FloatArray, a: FloatArray, gravity: tuple[float, float, float], Y: FloatArray
) -> None:
    n, N = q.shape
    # of each joint's frame, in its own coordinates: angular velocity, angular acceleration, acceleration less gravity
    motions: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    # by joint: of those that carry it, axis (3, N) and axis x lever, in its coordinates
    levers: list[dict[int, tuple[FloatArray, FloatArray]]] = []
    zero = np.zeros((3, N))
    base = zero, zero, np.repeat(-np.array(gravity)[:, None], N, axis=1)
    for i in range(n):
        parent, z = arm.parents[i], arm.axes[i][:, None]
        # (R turn)', from the parent's coordinates, (3, 3, N)
        angle = zero[0] if arm.prismatic[i] else q[i]
        to_own = np.tensordot(arm.R[i], _rotation(arm.axes[i], angle), 1).swapaxes(0, 1)
        w, dw, acc = motions[parent] if parent >= 0 else base
        p = arm.p[i][:, None] + (arm.R[i] @ z * q[i] if arm.prismatic[i] else 0.0)
        acc = acc + _cross(dw, p) + _cross(w, _cross(w, p))
        w, dw, acc = (_turn(to_own, x) for x in (w, dw, acc))
        axis = np.broadcast_to(z, (3, N))
        if arm.prismatic[i]:
            acc = acc + axis * a[i] + 2.0 * _cross(w, axis * v[i])
        else:
            dw = dw + _cross(w, axis * v[i]) + axis * a[i]
            w = w + axis * v[i]
        motions.append((w, dw, acc))
        levers.append({i: (zero, axis) if arm.prismatic[i] else (axis, zero)})
        for j, (z_j, m_j) in (levers[parent] if parent >= 0 else {}).items():
            # m = z x (p_i - p_j) grows by z x p from the parent's frame to this one
            lever = m_j + _cross(z_j, np.broadcast_to(p, (3, N)))
            levers[i][j] = _turn(to_own, z_j), _turn(to_own, lever)
        for j, (z_j, m_j) in levers[i].items():
            _link_terms(z_j, m_j, w, dw, acc, Y[j, 10 * i : 10 * i + 10])


def _link_terms(z: FloatArray, m: FloatArray, w: FloatArray, dw: FloatArray, acc: FloatArray, into: FloatArray) -> None:
    """Write what the ten parameters of a link add to the torque about an axis z with m = z x lever, shape (10, N)."""
    into[0] = (m * acc).sum(0)
    # of a force on the centre of mass, and of the moment c x acc
    into[1:4] = _cross(m, dw) + _cross(_cross(m, w), w) + _cross(acc, z)
    zw = _cross(z, w)
    row = 4
    for i in range(3):
        for j in range(i, 3):
            into[row] = z[i] * dw[j] + zw[i] * w[j]
            if i != j:
                into[row] += z[j] * dw[i] + zw[j] * w[i]
            row += 1


def _turn(R: FloatArray, x: FloatArray) -> FloatArray:
    """Return R x of rotations (3, 3, N) and vectors (3, N)."""
    return np.asarray(R[:, 0] * x[0] + R[:, 1] * x[1] + R[:, 2] * x[2])


def _cross(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the cross product of (3, N) by (3, N), several times faster than NumPy's."""
    return np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])


def _rotation(axis: FloatArray, angle: FloatArray) -> FloatArray:
    """Return rotations about an axis (3,) by angles (N,), shape (3, 3, N) (Rodrigues' formula)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.eye(3)[..., None] + K[..., None] * s + (K @ K)[..., None] * (1.0 - c))


def joint_positions(arm: Kinematics, q: FloatArray) -> FloatArray:
    """Return where the joints are in the frame of the base [m], shape (n, 3), at positions q (n,)."""
    poses: list[tuple[FloatArray, FloatArray]] = []
    for i in range(arm.size):
        R, p = poses[arm.parents[i]] if arm.parents[i] >= 0 else (np.eye(3), np.zeros(3))
        slide = arm.R[i] @ arm.axes[i] * q[i] if arm.prismatic[i] else np.zeros(3)
        turn = np.eye(3) if arm.prismatic[i] else _rotation(arm.axes[i], q[i : i + 1])[..., 0]
        poses.append((R @ arm.R[i] @ turn, p + R @ (arm.p[i] + slide)))
    return np.array([p for _, p in poses])
