"""Linear algebra for many small and for a few large matrices, and the threads and processes that share the cores.

The result for one axis is the same bit for bit, however many axes are computed with it and however many threads there
are: therefore online and offline estimates are equal. A new function keeps this: sums of a fixed order, written out or
as one product for each axis.
"""
