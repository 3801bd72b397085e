"""Corners in both raw images of many board scans -> the rig, jointly with the motion."""
