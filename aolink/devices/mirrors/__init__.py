"""Mirrors of other makers: one module each, named as an entry point in pyproject.toml."""
