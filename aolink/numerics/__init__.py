"""Linear algebra of many small and of few large matrices, and the threads and processes that share the cores."""
