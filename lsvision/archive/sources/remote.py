"""Archives behind an fsspec URL: their scans are copied to this machine, each file once."""

import json
import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import yaml
from fsspec.implementations.local import LocalFileSystem

from lsvision.archive.sources.catalogue import PATTERN_SIGNS, SCAN_FILE
from lsvision.errors import ConfigError
from lsvision.io import write_json

_MANIFEST = ".copied.json"
# What changes with a file, cheap to ask for; every file system knows some of them.
_STAMPS = ("size", "ETag", "etag", "mtime", "LastModified", "last_modified", "modified", "created")


def local_archive(archive: str, copies: Path) -> str:
    """The archive as ``find_scans`` takes it: a URL's scans copied below a folder, anything else as it is.

    Args:
        archive: a folder, or a pattern that scan folders match, as ``s3://bucket/2024-*/*``. The protocol may need
            another package (s3fs, gcsfs, ..).
        copies: folder of the copies, which mirror the archive. Files that are there and unchanged stay; what the
            archive no longer has is removed.

    Raises:
        ConfigError: an unknown protocol, no scans there, or the file system cannot be read.
    """
    if "://" not in archive:
        return archive
    try:
        files, place = fsspec.core.url_to_fs(archive)
        if isinstance(files, LocalFileSystem):
            return str(place)
        _copy(files, str(place).rstrip("/"), copies)
    except (ImportError, ValueError, OSError) as error:
        raise ConfigError(f"archive: {archive} cannot be read: {error}") from error
    return str(copies)


def _copy(files: fsspec.AbstractFileSystem, place: str, copies: Path) -> None:
    names = [place] if any(sign in place for sign in PATTERN_SIGNS) else [place, f"{place}/**"]
    scans = sorted({str(found) for name in names for found in files.glob(f"{name}/{SCAN_FILE}")})
    if not scans:
        raise ConfigError(f"archive: no scans at {place}")
    root = posixpath.commonpath([posixpath.dirname(posixpath.dirname(scan)) for scan in scans])
    manifest = copies / _MANIFEST
    before = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
    now = {posixpath.relpath(path, root): (path, stamp) for path, stamp in _stamps(files, scans)}
    for name in before.keys() - now.keys():
        (copies / name).unlink(missing_ok=True)
    kept = {}
    for name, (path, stamp) in now.items():
        target = copies / name
        if before.get(name) != stamp or not target.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            files.get_file(path, str(target))
        kept[name] = stamp
    if kept != before:
        write_json(manifest, kept)


def _stamps(files: fsspec.AbstractFileSystem, scans: list[str]) -> Iterator[tuple[str, str]]:
    """Every file of some scans, the rigs beside them too, and a text that changes with it."""
    for scan in scans:
        folder = posixpath.dirname(scan)
        found: dict[str, dict[str, Any]] = files.find(folder, detail=True)
        rig = _rig_beside(files, scan)
        if rig is not None and rig not in found and files.exists(rig):
            found[rig] = files.info(rig)
        for path, details in found.items():
            yield str(path), repr([str(details[key]) for key in _STAMPS if key in details])


def _rig_beside(files: fsspec.AbstractFileSystem, scan: str) -> str | None:
    try:
        values = yaml.safe_load(files.cat_file(scan))
    except yaml.YAMLError:
        return None  # reported where the scan is read
    rig = values.get("rig") if isinstance(values, dict) else None
    return posixpath.normpath(posixpath.join(posixpath.dirname(scan), rig)) if isinstance(rig, str) else None
