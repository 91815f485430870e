"""Films and pictures in other people's files: what they show, when, and how it may be written again.

Whatever takes pictures reads them here, so that a stack, a folder and a single picture give the same numbers. A new
format is a function from a path to a `Film`, its suffix in the table of `formats`, a line in
`pages/import_and_export.md`, and a test that reads a file written by other software.
"""
