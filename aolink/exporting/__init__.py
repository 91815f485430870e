"""Exposures and their estimates for other programs: arrays, tables, datasets, files."""
