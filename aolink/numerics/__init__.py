"""Linear algebra for many small and for a few large matrices, and the threads and processes that share the cores."""
