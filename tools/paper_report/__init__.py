"""The content of `tools/paper`: the figures, the numbers and the claims of Mishra & Wen, from our own runs."""
