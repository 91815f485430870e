"""Exposures and their estimates for other programs: arrays, tables, datasets, files.

It reads no file itself: what it takes is an `aolink.series.Series`. A new format is a function in `files`, its suffix
in `WRITERS`, a line in `pages/import_and_export.md`, and a test that reads the file with the format's own reader.
"""
