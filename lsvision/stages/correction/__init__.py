"""Scan, depth and motion -> product."""
