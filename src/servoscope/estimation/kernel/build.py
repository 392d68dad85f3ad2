"""The machine code of a recursion: templates filled with the sizes of a specification and with the traced steps."""

from __future__ import annotations

import functools
from collections import namedtuple
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from servoscope.core.jit import inline, kernel, make_transpose, specialise, trace_function
from servoscope.estimation import estimators
from servoscope.estimation.kernel import run, tile, transpose
from servoscope.estimation.kernel.evaluation_steps import EvaluationSteps
from servoscope.estimation.kernel.sample_steps import CUSUM_BATCH, HEADER_SIZE, TILE, KernelSpec, SampleSteps

# The templates find the method `step` of these steps under the name `_step`.
EVALUATION_STEPS = "write_evaluation", "write_response", "write_internal"
SAMPLE_STEPS = (
    *("begin_evaluation", "is_undisturbed", "count_sample", "advance_filters", "is_update", "update_estimate"),
    *("store_residual", "end_evaluation"),
)
# loops over the samples of a tile, and the arrays that stay in registers meanwhile
TILE_LOOPS = {
    **{"accumulate_size": ("e",), "advance_shadow": ("s",), "update_undisturbed": ("s", "h")},
    **{"whiten_undisturbed": ("s", "h"), "update_alarm": ("s", "h")},
}
# as `_step_one`, for one lane whose neighbours may do something else
SINGLE_LANE_STEPS = "begin_filters", "advance_filters", "update_estimate", "record_update", "reset_noise"


@functools.cache
def build_kernels(spec: KernelSpec, lanes: int, width: int, own: int) -> SimpleNamespace:
    """Return the drivers of `kernel.run` by name; each compiles when it is first called.

    `width` of the `lanes` go into a vector; `own` is 1 if each asset has constants of its own, else 0.
    """
    estimator, sizes = estimators.load_estimator(spec.estimator), spec.sizes
    single = lanes == 1
    steps = SampleSteps(spec, getattr(estimator, "steady_gain", None), single)
    evaluation = EvaluationSteps(spec)
    shared = "" if own else "c"
    names: dict[str, object] = {
        **{f"_{x}": getattr(sizes, x) for x in ("n", "rows", "row", "floats", "frequencies", "extra", "watched")},
        **{"_columns": spec.shadow_rows, "_gain_rows": sizes.n + 2, "_tile": 4 * TILE},
        **{"_sums": spec.sums, "_sums_at": dict(spec.to).get("sums", 0)},
        **{
            "_shadow": sizes.shadow,
            "_residual_rows": (steps.columns + 1) * TILE,
            "_lanes": lanes,
            "_width": width,
            "_own": own,
        },
        "_size": HEADER_SIZE + sizes.floats + sizes.watched + sizes.extra,
        "_cusum_lanes": CUSUM_BATCH if single else lanes,  # CUSUMs of one asset side by side, or those of several
        "_to": namedtuple("To", dict(spec.to))(**dict(spec.to)),
        "_at": namedtuple("At", dict(spec.at))(**dict(spec.at)),
        "_update": estimator.update,
        "_reduce_cusums": trace_function(steps.reduce_cusums),
        "_transpose": make_transpose(width),
        "_transpose_header": make_transpose(HEADER_SIZE),
    }
    update_cusums = steps.update_cusums_by_sums if spec.sums else steps.update_cusums
    if single:
        observed = "sums" if spec.sums else "w"
        names["_update_cusums"] = trace_function(update_cusums, CUSUM_BATCH, observed, ("g",))
    else:
        names["_update_cusums"] = trace_function(update_cusums, width, shared, ("g",))
    for step in SAMPLE_STEPS:
        names[f"_{step}"] = trace_function(getattr(steps, step), width, shared)
    for step, kept in TILE_LOOPS.items():
        names[f"_{step}"] = trace_function(getattr(steps, step), width, shared, kept)
    for step in EVALUATION_STEPS:
        names[f"_{step}"] = trace_function(getattr(evaluation, step), width, shared)
    for step in SINGLE_LANE_STEPS:
        names[f"_{step}_one"] = trace_function(getattr(steps, step))

    heap = not sizes.steady  # estimators with a P of their own allocate
    fits = not single and min(sizes.row, sizes.floats) >= width
    templates: list[tuple[Callable[..., Any], Callable[..., Any]]] = list(
        zip(transpose.COPIES, transpose.TRANSPOSES, strict=True)
    )
    for copy, transposed in templates:
        each = inline(specialise(copy, names), heap)
        names[f"_{copy.__name__}_each"] = each
        names[f"_{copy.__name__}"] = inline(specialise(transposed, names), heap) if fits else each
    undisturbed = (not single or sizes.watched) and sizes.steady and not sizes.speed
    roles = {  # the templates that these sizes take for steps of which there are several
        "learn_steady" if sizes.steady else "learn_general": "_learn_lane",
        "learn_lanes_steady" if sizes.steady else "learn_lanes_general": "_learn_lanes",
        "process_undisturbed" if undisturbed else "decline": "_try_undisturbed",
        "write_internals" if sizes.start else "write_evaluations": "_evaluate",
    }
    for template in tile.TEMPLATES:
        name = template.__name__
        names[roles.get(name, f"_{name}")] = inline(specialise(template, names), heap)
    variant = repr((spec, lanes, width, own))
    return SimpleNamespace(
        **{driver.__name__: kernel(specialise(driver, names, variant), heap) for driver in run.DRIVERS}
    )
