"""Tables of numbers are read as spreadsheets and loggers mean them, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from aolink.errors import RestorationError
from aolink.restoration.texts import read_log, read_psf


@pytest.mark.parametrize(
    ("text", "psf"),
    [
        ("0,5\t0,25\t0,4\r\n", [0.5, 0.25, 0.4]),
        ("0,05;0,25\n1;2\n", [[0.05, 0.25], [1, 2]]),
        ("0,5 0,25 0,4\n", [0.5, 0.25, 0.4]),
        ("\ufeff0.05,0.25\n1,2\n", [[0.05, 0.25], [1, 2]]),
        ("# a PSF\n1, 2, 3\n", [1, 2, 3]),
        ("0,05\n0,25\n", None),
        ("0,05,0,25,0,4\n", None),
        ("1,2\n3,4\n", None),
        ("1,234.5;2\n", None),
    ],
)
def test_a_psf_with_decimal_commas(text, psf, tmp_path):
    (tmp_path / "psf.csv").write_text(text, newline="")
    if psf is None:
        with pytest.raises(RestorationError, match=r"commas|convert"):
            read_psf(tmp_path / "psf.csv")
    else:
        assert read_psf(tmp_path / "psf.csv")[0].tolist() == psf


T, X, Y = np.arange(5) / 8, np.array([1.0, 3.0, 2.0, 5.0, 4.0]), np.array([0.0, -1.0, 1.0, 2.0, 0.5])


@pytest.mark.parametrize(
    ("head", "columns", "between"),
    [
        ("t,y,x", (T, Y, X), ","),
        ("time_ms;x;y", (T * 1e3, X, Y), ";"),
        ("# timestamp_us x_px y_px", (T * 1e6, X, Y), " "),
        ("gyro,Time (s),x,y", (X, T, X, Y), ","),
        ("time_ns\tx\ty", (T * 1e9, X, Y), "\t"),
        (None, (T, X, Y), ", "),
        ("t,roll,pitch", None, ","),
        ("t,x_mm,y_mm", None, ","),
        ("x,y", None, ","),
    ],
)
def test_a_log_whose_first_row_names_its_columns(head, columns, between, tmp_path):
    rows = [between.join(f"{each:.17g}" for each in row) for row in zip(*(columns or (T, X, Y)), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join([*([head] if head else []), *rows]), encoding="utf-8-sig")
    if columns is None:
        with pytest.raises(RestorationError, match="columns"):
            read_log(tmp_path / "log.csv")
    else:
        times, places = read_log(tmp_path / "log.csv")
        np.testing.assert_allclose(times, T, atol=1e-9)
        np.testing.assert_array_equal(places, [X, Y])
