"""Numbers, names and times as people read them."""

from __future__ import annotations

import pytest

from servoscope.report import wording


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (wording.number(0.0), "0"),
        (wording.number(float("nan")), "–"),
        (wording.number(-12.3456), "−12.35"),
        (wording.number(1.234e-9, 3), "1.23 × 10<sup>−9</sup>"),
        (wording.with_std(0.25993, 0.00021, 0.26), ("0.25993", "0.00021", "0.26000")),
        (wording.with_std(5.5e-5, 1.2e-6), ("5.50 × 10<sup>−5</sup>", "0.12 × 10<sup>−5</sup>")),
        (wording.quantity(1e9), "1 × 10<sup>9</sup>"),
        (wording.quantity(0.025), "0.025"),
        (wording.probability(1.0), "> 99.9 %"),
        (wording.probability(0.0), "< 0.1 %"),
        (wording.size_of(20.0, 19.0, 21.0), ("× 20.0", "× 19.0", "× 21.0")),
        (wording.size_of(0.9, 0.89, 0.91), ("−10.0 %", "−11.0 %", "−9.0 %")),
        (wording.ratios(0.3, 0.3, 0.3), ("0.300", "0.300", "0.300")),
        (wording.ratios(1.02, 1.0194, 1.0206), ("1.0200", "1.0194", "1.0206")),
        (wording.meaning("pump + leakage", {"pump": "weak pump (or valve)"}), "weak pump and leakage"),
        (wording.with_symbols("beta x 0.7 & C_ie"), "<i>β</i> × 0.7 &amp; <i>C</i><sub>ie</sub>"),
        (wording.clock_time(3723.0), "3723.0 s (1 h 2 min 3 s)"),
        (wording.symbol("C_ie"), "<i>C</i><sub>ie</sub>"),
        (wording.symbol("theta_0"), "<i>θ</i><sub>0</sub>"),
        (wording.symbol("viscous_friction"), "viscous friction"),
        (wording.plain_symbol("theta_0"), "θ₀"),
    ],
)
def test_numbers_and_names_read_well(told: object, expected: object) -> None:
    assert told == expected
