"""Calibration and correction of the motion distortion of binocular line-scan stereo cameras."""

__version__ = "0.2.0"
