"""The hash that tells one scan from another."""

import hashlib
from pathlib import Path

import yaml

_BLOCK = 1 << 20
FILE_KEYS = ("rig", "left", "right", "depth", "encoder")


def scan_sha256(path: Path | str) -> str:
    """SHA-256 over ``scan.yaml`` and everything it names, in a fixed order.

    Args:
        path: the folder of a scan that ``read_scan`` accepts.
    """
    path = Path(path)
    data = yaml.safe_load((path / "scan.yaml").read_text(encoding="utf-8"))
    digest = hashlib.sha256()
    named = [path / data[key] for key in FILE_KEYS if key in data]
    for entry in [path / "scan.yaml", *named]:
        files = sorted(file for file in entry.rglob("*") if file.is_file()) if entry.is_dir() else [entry]
        for file in files:
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK):
                    digest.update(block)
    return digest.hexdigest()
