"""Measurements of a frame: its moments, its profiles or the windows about its spots, with their noise."""
