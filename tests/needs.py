"""What some tests need beside the core: where it is missing they are skipped, and with AOLINK_REQUIRE_ALL they fail."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any, NoReturn

import pytest


def missing(what: str, error: Exception) -> NoReturn:
    """Skip a test or a whole module; in CI, which sets AOLINK_REQUIRE_ALL, raise ``error``."""
    if os.environ.get("AOLINK_REQUIRE_ALL"):
        raise error
    pytest.skip(f"{what} is missing", allow_module_level=True)


def needed(module: str) -> Any:
    """A module of an extra, or of the developers' tools."""
    try:
        return import_module(module)
    except ImportError as error:
        missing(module, error)
