"""The paper's claims about sensitivity and estimation: Sections 2 and 3.1, Figs. 2, 5, 6 and 8."""

from __future__ import annotations

from servoscope.research.paper.conditions import TABLE_2
from servoscope.research.paper.quartiles import ClaimResult, MetricQuartiles, claim_verdict


def _selectivity(n: MetricQuartiles) -> ClaimResult:
    same = n("sensitivity.angle_difference") < 1e-6
    return ClaimResult(
        f"Angles between the four sensitivities differ by {n.text('sensitivity.angle_difference')} degrees between G "
        f"and H; from 1 to 20 Hz they grow {n.text('sensitivity.growth_H')} times in H and fall to "
        f"{n.text('sensitivity.growth_G')} in G.",
        claim_verdict(False, same),
    )


def _selectivity_over_frequency(n: MetricQuartiles) -> ClaimResult:
    up = n("sensitivity.b_p-beta.20") > 2.0 * n("sensitivity.b_p-beta.1")
    worse = n("sensitivity.C_ie-b_p.20") < 0.5 * n("sensitivity.C_ie-b_p.1")
    return ClaimResult(
        f"Friction against contamination: {n.text('sensitivity.b_p-beta.1')}, {n.text('sensitivity.b_p-beta.10')}, "
        f"{n.text('sensitivity.b_p-beta.20')} degrees at 1, 10, 20 Hz; leakage against friction: "
        f"{n.text('sensitivity.C_ie-b_p.1')}, "
        f"{n.text('sensitivity.C_ie-b_p.10')}, {n.text('sensitivity.C_ie-b_p.20')}.",
        claim_verdict(up and not worse, up),
    )


def _loop_stability(n: MetricQuartiles) -> ClaimResult:
    return ClaimResult(
        f"Largest closed-loop pole over healthy and {len(TABLE_2)} faults: {n.text('stability.largest')}.",
        claim_verdict(n("stability.largest") < 1.0),
    )


def _windup(n: MetricQuartiles) -> ClaimResult:
    still = n("windup.dark.akf") <= 1.0 and n("windup.rest.akf") < 1.05
    told = "; ".join(
        f"{name.upper()} {n.text(f'windup.rest.{name}')} and {n.text(f'windup.dark.{name}')}"
        for name in ("akf", "dfrls", "kf", "rls")
    )
    return ClaimResult(
        f"Growth of P over ten minutes at rest, and over 20000 updates at phi = 0, memory 10 s: {told}.",
        claim_verdict(still and n("windup.dark.dfrls") <= 1.0 and n("windup.rest.kf") > 2.0, still),
    )


def _eq12(n: MetricQuartiles) -> ClaimResult:
    moving = n("eq12.motion.60.largest") < 0.01
    return ClaimResult(
        f"Left of P - P_d after one memory and six: {n.text('eq12.motion.10.largest')} and "
        f"{n.text('eq12.motion.60.largest')} in motion; {n.text('eq12.dark.60.largest')} at phi = 0.",
        claim_verdict(moving and n("eq12.dark.60.largest") < 0.01, moving),
    )


def _parameter_scatter(n: MetricQuartiles) -> ClaimResult:
    ratio, own = n("equal_rise.cv_theta.dfrls"), n("akf.cv_theta") / n("dfrls.cv_theta")
    return ClaimResult(
        f"CV_theta: AKF {n.text('akf.cv_theta')}, DFRLS {n.text('dfrls.cv_theta')}; at equal rise time AKF/DFRLS is "
        f"{n.text('equal_rise.cv_theta.dfrls')} (in motion {n.text('equal_rise.cv_theta.motion.dfrls')}, at rest "
        f"{n.text('equal_rise.cv_theta.rest.dfrls')}).",
        claim_verdict(ratio < 0.7 and own < 0.7, ratio < 0.95 or own < 0.95),
    )


def _ifrf_scatter(n: MetricQuartiles) -> ClaimResult:
    ratio = n("equal_rise.cv_H.dfrls")
    return ClaimResult(
        f"CV_H at 1 Hz: AKF {n.text('akf.cv_H.1')}, DFRLS {n.text('dfrls.cv_H.1')}; at equal rise time AKF/DFRLS is "
        f"{n.text('equal_rise.cv_H.dfrls')}, KF {n.text('equal_rise.cv_H.kf')}, RLS {n.text('equal_rise.cv_H.rls')} "
        "(AKF over each).",
        claim_verdict(ratio < 0.7, ratio < 0.95),
    )


def _ifrf_against_parameters(n: MetricQuartiles) -> ClaimResult:
    names = ("akf", "dfrls")
    at_1 = max(n(f"{name}.cv_H.1") / n(f"{name}.cv_theta") for name in names)
    everywhere = max(n(f"{name}.cv_H.{f}") / n(f"{name}.cv_theta") for name in names for f in ("1", "10", "20"))
    told = "; ".join(
        f"{name.upper()} {n.text(f'{name}.cv_theta')} against "
        + ", ".join(n.text(f"{name}.cv_H.{f}") for f in ("1", "10", "20"))
        for name in names
    )
    return ClaimResult(
        f"CV_theta against CV_H at 1, 10, 20 Hz: {told}.",
        claim_verdict(everywhere < 0.6, at_1 < 1.0),
    )


def _tracking(n: MetricQuartiles) -> ClaimResult:
    good = max(n("akf.before"), n("dfrls.before"), n("akf.after"), n("dfrls.after"))
    return ClaimResult(
        f"Error at 1 Hz before the fault: AKF {n.percent('akf.before')}, DFRLS {n.percent('dfrls.before')}; at the end "
        f"{n.percent('akf.after')}, {n.percent('dfrls.after')}. Half of the way after {n.text('akf.rise.0.5')} and "
        f"{n.text('dfrls.rise.0.5')} s, 90 % after {n.text('akf.rise.0.9')} and {n.text('dfrls.rise.0.9')} s. Default: "
        f"{n.percent('default.before')}, {n.percent('default.after')}, {n.text('default.rise.0.5')} and "
        f"{n.text('default.rise.0.9')} s.",
        claim_verdict(good < 0.02 and n("akf.rise.0.9") < 5.0, good < 0.1),
    )


def _bias(n: MetricQuartiles) -> ClaimResult:
    imag, real = abs(n("akf.own_bias_imag")), abs(n("akf.own_bias_real"))
    cause = abs(n("noise_free.tustin-straight.imag")) < 0.1 * abs(n("noise_free.tustin.imag"))
    return ClaimResult(
        f"At 1 Hz: imaginary part {n.percent('akf.own_bias_imag')}, real part {n.percent('akf.own_bias_real')} of "
        f"itself. Without noise: {n.percent('noise_free.tustin.imag')}; where u runs in straight lines "
        f"{n.percent('noise_free.tustin-straight.imag')}; state-variable filter {n.percent('noise_free.svf.imag')}. "
        f"With filtered y in phi: {n.percent('akf-filtered.own_bias_imag')}, real part "
        f"{n.percent('akf-filtered.own_bias_real')}, CV_theta {n.text('akf-filtered.cv_theta')} against "
        f"{n.text('akf.cv_theta')} with raw y.",
        claim_verdict(imag < 0.1 and real < imag, imag < 0.1),
        cause,
    )


CLAIMS = {
    "selective": _selectivity,
    "selective-with-frequency": _selectivity_over_frequency,
    "stable": _loop_stability,
    "no-windup": _windup,
    "eq-12": _eq12,
    "akf-quieter-parameters": _parameter_scatter,
    "akf-quieter-ifrf": _ifrf_scatter,
    "ifrf-quieter": _ifrf_against_parameters,
    "tracking": _tracking,
    "imaginary-bias": _bias,
}
