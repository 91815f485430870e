from __future__ import annotations

from tests.viewing.conftest import without_vulkan as without_vulkan
