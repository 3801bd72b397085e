"""Scan, depth and motion -> motion from line to line."""
