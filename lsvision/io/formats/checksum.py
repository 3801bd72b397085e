"""The hash that identifies the data of a scan."""

import hashlib
from pathlib import Path

from lsvision.errors import FileFormatError
from lsvision.io.formats.scan_files import scan_files

_BLOCK = 1 << 20


def scan_sha256(path: Path | str) -> str:
    """SHA-256 over ``scan.yaml`` and every file it names, in a fixed order.

    Args:
        path: the folder of a scan that ``read_scan`` accepts.

    Raises:
        FileFormatError: a file that it names is missing, a device or a pipe.
    """
    digest = hashlib.sha256()
    for file in scan_files(path):
        if not file.is_file():
            raise FileFormatError(file, "no such file")
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()
