"""Scans of an archive -> signals of drift that need no target."""
