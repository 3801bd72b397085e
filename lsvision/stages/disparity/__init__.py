"""Scan -> disparity -> depth."""
