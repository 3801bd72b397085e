"""The files of lsvision as plain data: rig, scan, encoder log and calibration."""
