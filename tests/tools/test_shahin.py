"""Shahin's example: what the page says of it, by other ways of finding it."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy import signal

from tests.needs import needed

needed("matplotlib")
Image = needed("PIL.Image")

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def shahin(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(TOOLS))
    return importlib.import_module("paper_report.shahin")


@pytest.mark.slow
def test_the_page_and_its_figures(shahin: ModuleType, tmp_path: Path) -> None:
    page = shahin.make(tmp_path, quick=True).read_text(encoding="utf-8")
    for words in ("variance 6.092", "correlate by 0.873", "32 and 16.1 pixels", "-0.0038", "5.25 as printed"):
        assert words in page
    for number in ("1-3", "4-5", "6-7"):
        pixels = np.asarray(Image.open(tmp_path / f"shahin-{number}.png").convert("L"))
        assert pixels.std() > 20
        assert f"(shahin-{number}.png)" in page
    assert "data:image/png" in (tmp_path / "shahin.html").read_text(encoding="utf-8")


def test_the_blur_is_a_causal_mean(shahin: ModuleType) -> None:
    rest = np.full((32, 4), -4 / 5) * np.array([1, 0.75, 0.5, 0.25])
    expected, _ = signal.lfilter(np.full(5, 0.2), [1.0], shahin.scene(), axis=1, zi=rest)
    assert shahin.degraded(0.0, 0) == pytest.approx(expected, abs=1e-12)


def test_an_alignment_by_index_flatters_what_is_restored(shahin: ModuleType) -> None:
    """Index for index a causal blur looks worse than it is, so what is restored looks better."""
    image = shahin.degraded(0.1, 1)
    scanner, _ = shahin.models()["first order, α = 0.873"]
    found = shahin.restored(image, "smoother", scanner, 0.1)
    assert shahin.isnr(image, found, False) > shahin.isnr(image, found, True) + 3
    assert shahin.isnr(image, image, False) == pytest.approx(0)


def test_each_later_look_is_better(shahin: ModuleType) -> None:
    for model in shahin.models():
        gains = [shahin.gain(model, m, 0.1, (1.0, 1.0), 3).aligned for m in ("predictor", "filter", "lag")]
        assert gains == sorted(gains)
