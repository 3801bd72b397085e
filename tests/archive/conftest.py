"""One archive of small scans, shared by the tests, and its calibration."""

from pathlib import Path

import pytest

from tests.archive.archives import make_calibration, make_scan


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scans, two with a right image, in nested folders."""
    root = tmp_path_factory.mktemp("archive")
    make_scan(root / "a", 150, 1)
    make_scan(root / "b", 90, 2, stereo=True)
    make_scan(root / "2024" / "c", 40, 3, stereo=True)
    make_scan(root / "2024" / "d", 96, 4)
    return root


@pytest.fixture(scope="session")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motion askew and stretched."""
    return make_calibration(tmp_path_factory.mktemp("calibration") / "calibration.json")
