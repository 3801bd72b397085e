"""Corners -> calibration: the motion, how well it is known, and the next scan to make."""
