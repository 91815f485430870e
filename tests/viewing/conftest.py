from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def without_vulkan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """A machine on which the viewer cannot draw: the Vulkan loader is told, by both names of its setting, to look for
    drivers where there are none.
    """
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "no-driver.json"))
    monkeypatch.setenv("WGPU_BACKEND", "dx12")  # which no Linux machine has: OpenGL is not to take Vulkan's place
    return monkeypatch
