"""Checkerboards in images: the lattice of saddles, its order, and every corner to a fraction of a pixel."""
