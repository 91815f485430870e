"""Kalman filters: prediction and correction, from exposure to exposure."""
