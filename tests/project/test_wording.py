"""Numbers, names and times as people read them."""

from __future__ import annotations

import pytest

from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.report import format_values

PUMP = FaultEstimate(name="pump", parameter="p_s", ratio=0.9, interval=(0.8, 1.0))
LEAKAGE = FaultEstimate(name="leakage", parameter="C_ie", ratio=1.2, interval=(1.1, 1.3))
PAIR = Candidate(name="pump + leakage", probability=0.9, faults=(PUMP, LEAKAGE))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (format_values.format_number(0.0), "0"),
        (format_values.format_number(float("nan")), "–"),
        (format_values.format_number(-12.3456), "−12.35"),
        (format_values.format_number(1.234e-9, 3), "1.23 × 10⁻⁹"),
        (format_values.format_with_std(0.25993, 0.00021, 0.26), ("0.25993", "0.00021", "0.26000")),
        (format_values.format_with_std(5.5e-5, 1.2e-6), ("5.50 × 10⁻⁵", "0.12 × 10⁻⁵")),
        (format_values.format_quantity(1e9), "1 × 10⁹"),
        (format_values.format_quantity(0.025), "0.025"),
        (format_values.format_probability(1.0), "> 99.9 %"),
        (format_values.format_probability(0.0), "< 0.1 %"),
        (format_values.format_size(20.0, 19.0, 21.0), ("× 20.0", "× 19.0", "× 21.0")),
        (format_values.format_size(0.9, 0.89, 0.91), ("−10.0 %", "−11.0 %", "−9.0 %")),
        (format_values.format_ratios(0.3, 0.3, 0.3), ("0.300", "0.300", "0.300")),
        (format_values.format_ratios(1.02, 1.0194, 1.0206), ("1.0200", "1.0194", "1.0206")),
        (format_values.describe_candidate(PAIR, {"pump": "weak pump (or valve)"}), "weak pump and leakage"),
        (format_values.split_symbols("beta x 0.7 & C_ie"), ["", "beta", " × 0.7 & ", "C_ie", ""]),
        (format_values.format_percent(0.99984), "99.984 %"),
        (format_values.format_percent(1.0), "100 %"),
        (format_values.format_percent(1e-5), "< 0.1 %"),
        (format_values.format_duration(5400.0), "90 min"),
        (format_values.format_clock_time(3723.0), "3723.0 s (1 h 2 min 3 s)"),
        (format_values.symbol_parts("C_ie"), ("C", "ie")),
        (format_values.symbol_parts("theta_0"), ("θ", "0")),
        (format_values.symbol_parts("beta"), ("β", "")),
        (format_values.symbol_parts("viscous_friction"), None),
        (format_values.plain_name("viscous_friction"), "viscous friction"),
        (format_values.text_symbol("theta_0"), "θ₀"),
    ],
)
def test_numbers_and_names_read_well(text: object, expected: object) -> None:
    assert text == expected
