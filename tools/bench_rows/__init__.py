"""Rows of tools/bench that need more than a function each."""
