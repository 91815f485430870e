"""Drivers of cameras of other makers, each a module, found by name like a driver of another package."""
