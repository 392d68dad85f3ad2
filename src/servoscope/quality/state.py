"""The state of data quality: one array of finite numbers, whose places have names."""

from __future__ import annotations

import numpy as np

from servoscope.quality.findings import KINDS

VERSION = 1

# All of them numbers of the same type: for saving, an array (size,) of float64; for the kernel, a record.
LAYOUT = np.dtype(
    [
        ("version", np.float64),
        # the stream: samples so far, the last time stamp, and what the service had heard of them by when
        ("count", np.float64),
        ("t", np.float64),
        ("listens", np.float64),
        ("heard", np.float64),
        ("heard_at", np.float64),
        # the window: samples; steps of about one sample, and those that jitter; whole periods in a span [s], for the
        # rate; missing samples; jumps
        ("samples", np.float64),
        ("steps", np.float64),
        ("jittery", np.float64),
        ("periods", np.float64),
        ("span", np.float64),
        ("missing", np.float64),
        ("jumps", np.float64),
        # r, u and y: samples so far, the last ones, how long each has stayed the same [samples], smallest change
        ("values", np.float64),
        ("last", np.float64, (3,)),
        ("same", np.float64, (3,)),
        ("least", np.float64, (3,)),
        # lowest and highest of r, u, y and r - y: of this epoch, of the one before; windows in this epoch
        ("ranges", np.float64, (2, 4, 2)),
        ("windows", np.float64),
        # lowest and highest while y stays the same: r; while u does: y, r - y; while r does: y
        ("r_meanwhile", np.float64, (2,)),
        ("y_meanwhile", np.float64, (2,)),
        ("e_meanwhile", np.float64, (2,)),
        ("y_at_rest", np.float64, (2,)),
        # turns of y at rest, the way it went last, and whether it is known to be noisy there
        ("turns", np.float64),
        ("way", np.float64),
        ("noisy", np.float64),
        # what stands, 1 or 0, and since when (epoch, s); the order is that of KINDS
        ("stands", np.float64, (len(KINDS),)),
        ("since", np.float64, (len(KINDS),)),
    ]
)
SIZE = LAYOUT.itemsize // 8
