"""The paper's claims about sensitivity and estimation: Sections 2 and 3.1, Figs. 2, 5, 6 and 8."""

from __future__ import annotations

from servoscope.paper.conditions import TABLE_2
from servoscope.paper.numbers import Numbers, Row, judge


def _selective(n: Numbers) -> Row:
    same = n("sensitivity.angle_difference") < 1e-6
    return (
        "selective",
        "Sec. 2, Fig. 2",
        "H is selectively sensitive to the parameters, in contrast to G.",
        f"Angles between the four sensitivities differ by {n.say('sensitivity.angle_difference')} degrees between G "
        f"and H; from 1 to 20 Hz they grow {n.say('sensitivity.growth_H')} times in H and fall to "
        f"{n.say('sensitivity.growth_G')} in G.",
        judge(False, same),
        "dG = -G^2 dH turns all four by the same angle, so at any one frequency G and H tell parameters apart equally "
        "well. What H has is size: its sensitivities grow with frequency where those of G vanish.",
    )


def _with_frequency(n: Numbers) -> Row:
    up = n("sensitivity.b_p-beta.20") > 2.0 * n("sensitivity.b_p-beta.1")
    worse = n("sensitivity.C_ie-b_p.20") < 0.5 * n("sensitivity.C_ie-b_p.1")
    return (
        "selective-with-frequency",
        "Sec. 2, Fig. 2",
        "Selectivity becomes clearer as frequency increases.",
        f"Friction against contamination: {n.say('sensitivity.b_p-beta.1')}, {n.say('sensitivity.b_p-beta.10')}, "
        f"{n.say('sensitivity.b_p-beta.20')} degrees at 1, 10, 20 Hz; leakage against friction: "
        f"{n.say('sensitivity.C_ie-b_p.1')}, {n.say('sensitivity.C_ie-b_p.10')}, {n.say('sensitivity.C_ie-b_p.20')}.",
        judge(up and not worse, up),
        "k_p - m_p w^2 changes sign at 13 Hz, which turns friction away from contamination and towards leakage: no "
        "frequency tells all pairs apart, several together do. It is the mechanics, not the non-causality.",
    )


def _stable(n: Numbers) -> Row:
    return (
        "stable",
        "Sec. 4",
        "The PI controller keeps the loop stable with all faults of Table 2.",
        f"Largest closed-loop pole over healthy and {len(TABLE_2)} faults: {n.say('stability.largest')}.",
        judge(n("stability.largest") < 1.0),
        "Checked with the exact sampled plant; the slowest pole is the integrator's, 4 s, hardly moved by any fault.",
    )


def _windup(n: Numbers) -> Row:
    still = n("windup.dark.akf") <= 1.0 and n("windup.rest.akf") < 1.05
    told = "; ".join(
        f"{name.upper()} {n.say(f'windup.rest.{name}')} and {n.say(f'windup.dark.{name}')}"
        for name in ("akf", "dfrls", "kf", "rls")
    )
    return (
        "no-windup",
        "Sec. 3.1",
        "The AKF does not wind up without excitation, and neither does DFRLS; the KF does.",
        f"Growth of P over ten minutes at rest, and over 20000 updates at phi = 0, memory 10 s: {told}.",
        judge(still and n("windup.dark.dfrls") <= 1.0 and n("windup.rest.kf") > 2.0, still),
        "At rest phi carries noise and position, so DFRLS creeps a little before it finds its level.",
    )


def _eq12(n: Numbers) -> Row:
    moving = n("eq12.motion.60.largest") < 0.01
    return (
        "eq-12",
        "Sec. 3.1, eq. (12)",
        "P - P_d converges to zero exponentially, whether or not there is excitation.",
        f"Left of P - P_d after one memory and six: {n.say('eq12.motion.10.largest')} and "
        f"{n.say('eq12.motion.60.largest')} in motion; {n.say('eq12.dark.60.largest')} at phi = 0.",
        judge(moving and n("eq12.dark.60.largest") < 0.01, moving),
        "Eq. (12) contracts along phi only. Elsewhere P stays where it is, bounded: that is the anti-windup.",
    )


def _quieter(n: Numbers) -> Row:
    ratio, own = n("equal_rise.cv_theta.dfrls"), n("akf.cv_theta") / n("dfrls.cv_theta")
    return (
        "akf-quieter-parameters",
        "Figs. 5 and 8",
        "The AKF's parameters scatter far less than those of DFRLS.",
        f"CV_theta: AKF {n.say('akf.cv_theta')}, DFRLS {n.say('dfrls.cv_theta')}; at equal rise time AKF/DFRLS is "
        f"{n.say('equal_rise.cv_theta.dfrls')} (in motion {n.say('equal_rise.cv_theta.motion.dfrls')}, at rest "
        f"{n.say('equal_rise.cv_theta.rest.dfrls')}).",
        judge(ratio < 0.7 and own < 0.7, ratio < 0.95 or own < 0.95),
        "It depends on P_d and the forgetting factor. DFRLS forgets less where little comes in, and its parameters "
        "are the quieter ones for that.",
    )


def _quieter_H(n: Numbers) -> Row:
    ratio = n("equal_rise.cv_H.dfrls")
    return (
        "akf-quieter-ifrf",
        "Fig. 8",
        "The AKF's iFRF scatters far less than that of DFRLS.",
        f"CV_H at 1 Hz: AKF {n.say('akf.cv_H.1')}, DFRLS {n.say('dfrls.cv_H.1')}; at equal rise time AKF/DFRLS is "
        f"{n.say('equal_rise.cv_H.dfrls')}, KF {n.say('equal_rise.cv_H.kf')}, RLS {n.say('equal_rise.cv_H.rls')} "
        "(AKF over each).",
        judge(ratio < 0.7, ratio < 0.95),
        "At 1 Hz the AKF is ahead of DFRLS; the plain KF and RLS, which wind up, are as good or better here.",
    )


def _ifrf_quieter(n: Numbers) -> Row:
    names = ("akf", "dfrls")
    at_1 = max(n(f"{name}.cv_H.1") / n(f"{name}.cv_theta") for name in names)
    everywhere = max(n(f"{name}.cv_H.{f}") / n(f"{name}.cv_theta") for name in names for f in ("1", "10", "20"))
    told = "; ".join(
        f"{name.upper()} {n.say(f'{name}.cv_theta')} against "
        + ", ".join(n.say(f"{name}.cv_H.{f}") for f in ("1", "10", "20"))
        for name in names
    )
    return (
        "ifrf-quieter",
        "Fig. 8",
        "The iFRF has much lower CVs than the parameters, whatever the estimator.",
        f"CV_theta against CV_H at 1, 10, 20 Hz: {told}.",
        judge(everywhere < 0.6, at_1 < 1.0),
        "H is a weighted sum of coefficients whose errors are correlated and cancel; how much depends on frequency "
        "and estimator. CV means little where Re H is near 0, as at 10 Hz.",
    )


def _tracking(n: Numbers) -> Row:
    good = max(n("akf.before"), n("dfrls.before"), n("akf.after"), n("dfrls.after"))
    return (
        "tracking",
        "Fig. 6",
        "The traces reach the nominal value before 30 s and the faulty one quickly thereafter.",
        f"Error at 1 Hz before the fault: AKF {n.percent('akf.before')}, DFRLS {n.percent('dfrls.before')}; at the end "
        f"{n.percent('akf.after')}, {n.percent('dfrls.after')}. Half of the way after {n.say('akf.rise.0.5')} and "
        f"{n.say('dfrls.rise.0.5')} s, 90 % after {n.say('akf.rise.0.9')} and {n.say('dfrls.rise.0.9')} s. Default: "
        f"{n.percent('default.before')}, {n.percent('default.after')}, {n.say('default.rise.0.5')} and "
        f"{n.say('default.rise.0.9')} s.",
        judge(good < 0.02 and n("akf.rise.0.9") < 5.0, good < 0.1),
        "They get there but for the bias, and not at once: half of each period is rest, where nothing is learned, "
        "and stage 1 has to follow first.",
    )


def _bias(n: Numbers) -> Row:
    imag, real = abs(n("akf.own_bias_imag")), abs(n("akf.own_bias_real"))
    cause = abs(n("noise_free.tustin-straight.imag")) < 0.1 * abs(n("noise_free.tustin.imag"))
    return (
        "imaginary-bias",
        "Fig. 6",
        "There is a slight bias in the imaginary part, of small impact compared with the real part.",
        f"At 1 Hz: imaginary part {n.percent('akf.own_bias_imag')}, real part {n.percent('akf.own_bias_real')} of "
        f"itself. Without noise: {n.percent('noise_free.tustin.imag')}; where u runs in straight lines "
        f"{n.percent('noise_free.tustin-straight.imag')}; state-variable filter {n.percent('noise_free.svf.imag')}. "
        f"With filtered y in phi: {n.percent('akf-filtered.own_bias_imag')}, real part "
        f"{n.percent('akf-filtered.own_bias_real')}, CV_theta {n.say('akf-filtered.cv_theta')} against "
        f"{n.say('akf.cv_theta')} with raw y.",
        judge(imag < 0.1 and real < imag, imag < 0.1),
        (
            "The cause is the held input: Tustin takes u for straight lines, and where it is, the bias is gone. "
            if cause
            else "The held input alone does not explain it. "
        )
        + "The real part suffers as well; at 1 Hz it is the smaller part of H.",
    )


ROWS = (
    _selective,
    _with_frequency,
    _stable,
    _windup,
    _eq12,
    _quieter,
    _quieter_H,
    _ifrf_quieter,
    _tracking,
    _bias,
)
