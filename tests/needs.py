"""What some tests need beside the core and the developers' tools.

Where it is missing they are skipped, and with AOLINK_REQUIRE_ALL they fail. CI sets that, and installs it all.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any, NoReturn

import pytest


def missing(what: str, error: Exception) -> NoReturn:
    """Skip a test or a whole module; in CI, which sets AOLINK_REQUIRE_ALL, raise ``error``."""
    if os.environ.get("AOLINK_REQUIRE_ALL"):
        raise error
    pytest.skip(f"needs {what}, which CI installs", allow_module_level=True)


def needed(module: str) -> Any:
    """A module that not every installation for the tests has."""
    try:
        return import_module(module)
    except ImportError as error:
        missing(module, error)
