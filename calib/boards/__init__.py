"""Calibration targets: what they are, and how corners are told as files."""
