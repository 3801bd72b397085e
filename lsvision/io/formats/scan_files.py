"""The files that a scan consists of."""

from collections.abc import Mapping
from pathlib import Path

from lsvision.errors import FileFormatError
from lsvision.io.formats.rig import CAMERAS
from lsvision.io.formats.scan import FILE_KEYS, SCAN_FILE, ScanEntries
from lsvision.io.formats.validation import named_file, read_entries, read_yaml


def scan_files(folder: Path | str) -> list[Path]:
    """The files that make a scan, in a fixed order: ``scan.yaml``, every file or folder that it names, and responses.

    A name whose file is missing is listed as well.

    Raises:
        FileFormatError: ``scan.yaml`` cannot be read.
    """
    folder = Path(folder)
    data = read_yaml(folder / SCAN_FILE)
    entries = data if isinstance(data, Mapping) else {}
    files = [folder / SCAN_FILE]
    for named in (folder / str(entries[key]) for key in FILE_KEYS if entries.get(key) is not None):
        files += sorted(file for file in named.rglob("*") if file.is_file()) if named.is_dir() else [named]
    return files + response_files(folder / str(entries.get("rig")))


def rig_file(scan: Path | str) -> Path:
    """The rig file that a scan names.

    Raises:
        FileFormatError: ``scan.yaml`` cannot be read, or names none.
    """
    path = Path(scan)
    file = path if path.is_file() else path / SCAN_FILE
    return named_file(file, "rig", read_entries(ScanEntries, read_yaml(file), file).rig)


def response_files(rig: Path) -> list[Path]:
    """The files of the responses that a rig file names; none where it cannot be read."""
    try:
        data = read_yaml(rig)
    except FileFormatError:
        return []
    named = data.get("response") if isinstance(data, Mapping) else None
    names = (named.get(camera) for camera in CAMERAS) if isinstance(named, Mapping) else ()
    return [rig.parent / name for name in names if isinstance(name, str)]
