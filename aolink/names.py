"""Names of a package that are loaded from its modules at their first use (PEP 562).

An import of one module of a package runs the package's own file first: if that imported all modules, reading an
estimate from a recording would load every estimator, and SciPy with them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def at_first_use(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package.

    Parameters
    ----------
    modules:
        Module of the package -> the names that the package has from it, with blanks between them.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{module_of[name]}"), name)

    return load
