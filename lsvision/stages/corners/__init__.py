"""Scan -> corners: the board's corners in both images."""
