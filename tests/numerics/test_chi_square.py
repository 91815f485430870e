"""Quantiles of the chi-square distribution, against SciPy's."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from aolink.numerics.chi_square import chi_square_quantile


@given(st.floats(1e-4, 1 - 1e-4), st.one_of(st.integers(1, 50), st.integers(50, 1_000_000)))
def test_a_quantile_is_scipys(share: float, degrees: int) -> None:
    assert chi_square_quantile(share, degrees) == pytest.approx(float(stats.chi2.ppf(share, degrees)), rel=1e-8)


@pytest.mark.parametrize(("share", "degrees"), [(0.0, 1), (1.0, 1), (float("nan"), 1), (0.5, 0), (0.5, -3)])
def test_what_has_no_quantile_is_an_error(share: float, degrees: int) -> None:
    with pytest.raises(ValueError, match="a share between 0 and 1 of a positive number of degrees"):
        chi_square_quantile(share, degrees)
