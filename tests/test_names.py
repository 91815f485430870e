"""Packages whose names are loaded from their modules at the first use."""

from __future__ import annotations

from importlib import import_module

import pytest

import aolink.estimation.score
import aolink.plotting.overview
from aolink.names import at_first_use

PACKAGES = ("aolink.estimation", "aolink.plotting", "aolink.viewing")


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_is_there_and_is_listed(package: str) -> None:
    module = import_module(package)
    assert set(module.__all__) <= set(dir(module))
    for name in module.__all__:
        assert getattr(module, name) is not None


@pytest.mark.parametrize("package", PACKAGES)
def test_a_name_that_there_is_not_is_named(package: str) -> None:
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nonsense'"):
        _ = import_module(package).nonsense


def test_a_function_with_the_name_of_its_module_is_the_function() -> None:
    assert callable(aolink.estimation.score)
    assert callable(aolink.plotting.overview)


def test_a_name_is_what_its_module_has() -> None:
    load = at_first_use("json", {"decoder": "JSONDecoder", "encoder": "JSONEncoder encode_basestring"})
    assert load("JSONEncoder") is import_module("json.encoder").JSONEncoder
