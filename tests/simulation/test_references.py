"""References: the motions of the test data, their rates and seeds, and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.core.errors import SimulationError
from servoscope.simulation import reference


class TestReferences:
    @pytest.mark.parametrize("kind", ["profile", "multisine", "trapezoid"])
    def test_test_data_to_the_printed_digits(self, eha_cases: Path, eha_truth: Any, kind: str) -> None:
        files = [name for name, case in eha_truth.items() if case["reference"] == kind and "defects" not in case]
        assert files
        for name in files:
            r = np.loadtxt(eha_cases / name, delimiter=",", skiprows=1)[:, 1]
            assert reference(kind, 60.0, 100.0) == pytest.approx(r, abs=1e-9)

    @pytest.mark.parametrize("kind", ["profile", "multisine", "trapezoid", "steps", "chirp"])
    def test_shape_period_and_amplitude(self, kind: str) -> None:
        r = reference(kind, 25.0, 200.0)
        assert r.shape == (5000,)
        assert np.array_equal(r[:2000], r[2000:4000])
        assert 0.0 < np.abs(r).max() <= 0.065
        assert reference(kind, 25.0, 200.0, amplitude=0.5) == pytest.approx(0.5 * r)

    @pytest.mark.parametrize("kind", ["profile", "multisine", "trapezoid", "steps", "chirp"])
    def test_the_same_motion_at_another_rate(self, kind: str) -> None:
        fine, coarse = reference(kind, 20.0, 300.0), reference(kind, 20.0, 100.0)
        assert fine[::3] == pytest.approx(coarse, abs=1e-12)
        assert reference(kind, 20.0, 33.3).shape == (666,)

    def test_seed(self) -> None:
        assert not np.array_equal(reference("multisine", 10.0, 100.0), reference("multisine", 10.0, 100.0, seed=1))

    def test_multisine_stays_below_the_nyquist_frequency(self) -> None:
        assert np.abs(reference("multisine", 10.0, 20.0)).max() < 0.1

    def test_csv_with_times(self, tmp_path: Path) -> None:
        file = tmp_path / "r.csv"
        file.write_text("t,r\n5.0,0\n5.5,1\n6.0,1\n6.5,0\n")
        r = reference(str(file), 3.0, 4.0)
        assert r == pytest.approx([0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0, 0.0, 0.5, 1.0, 1.0])

    @pytest.mark.parametrize("head", ["", "r\n"])
    def test_single_column(self, tmp_path: Path, head: str) -> None:
        file = tmp_path / "r.csv"
        file.write_text(head + "0\n1\n4\n")
        assert reference(file, 0.05, 100.0) == pytest.approx([0.0, 1.0, 4.0, 0.0, 1.0])

    def test_parquet(self, tmp_path: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        file = tmp_path / "r.parquet"
        pq.write_table(pa.table({"t": [0.0, 0.01, 0.02], "r": [1.0, 2.0, 3.0]}), file)
        assert reference(file, 0.03, 100.0) == pytest.approx([1.0, 2.0, 3.0])

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a,b\n1,2\n3,4\n", "columns t and r"),
            ("t,r\n0,1\n", "two or more"),
            ("t,r\n0,1\n2,1\n1,1\n", "row 2"),
            ("t,r\n0,one\n1,two\n", "cannot be read"),
            ("", "cannot be read"),
        ],
    )
    def test_files_that_cannot_be_used(self, tmp_path: Path, text: str, message: str) -> None:
        file = tmp_path / "r.csv"
        file.write_text(text)
        with pytest.raises(SimulationError, match=message) as caught:
            reference(file, 1.0, 100.0)
        assert "\n" not in str(caught.value) and "r.csv" in str(caught.value)

    def test_unknown(self, tmp_path: Path) -> None:
        with pytest.raises(SimulationError, match="choose from profile"):
            reference("sinus", 1.0, 100.0)
        with pytest.raises(SimulationError, match="cannot be read"):
            reference(tmp_path / "absent.csv", 1.0, 100.0)
        with pytest.raises(SimulationError, match="no samples"):
            reference("profile", 0.0, 100.0)
