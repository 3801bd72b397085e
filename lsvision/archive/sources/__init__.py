"""Where the scans of an archive and their calibrations come from."""
