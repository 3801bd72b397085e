"""Corners -> calibration: the motion, how well it is known, and what to scan next."""
