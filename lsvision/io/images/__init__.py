"""Tall images read by line ranges: TIFF, Zarr arrays, folders of frames."""
