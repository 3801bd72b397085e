"""Scans -> the response of the cameras' columns: offset and gain."""
