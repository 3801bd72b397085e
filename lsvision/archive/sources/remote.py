"""Archives behind an fsspec URL: their scans are copied to this machine, each file once."""

import json
import posixpath
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from lsvision.archive.sources.catalogue import COPIES_FILE, PATTERN_SIGNS, SCAN_FILE
from lsvision.errors import ConfigError, FileFormatError, LsvisionError
from lsvision.io import write_json
from lsvision.io.formats.rig import CAMERAS
from lsvision.io.formats.validation import YAML_BYTES, parse_yaml
from lsvision.io.inside import path_inside

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
        ConfigError: an unknown protocol, no scans there, a file whose name leads out of the archive, or the file system
            cannot be read.
    """
    if "://" not in archive:
        return archive
    try:
        files, place = fsspec.core.url_to_fs(archive)
        if isinstance(files, LocalFileSystem):
            return str(place)
        _copy(files, str(place).rstrip("/"), copies)
    except FileFormatError as error:
        raise ConfigError(f"archive: {archive}: {error}") from error
    except LsvisionError:
        raise
    except Exception as error:  # a damaged archive or URL surfaces as that of any library behind it
        raise ConfigError(f"archive: {archive} cannot be read: {' '.join(str(error).split())}") from error
    return str(copies)


def _copy(files: fsspec.AbstractFileSystem, place: str, copies: Path) -> None:
    names = [place] if any(sign in place for sign in PATTERN_SIGNS) else [place, f"{place}/**"]
    scans = sorted({str(found) for name in names for found in files.glob(f"{name}/{SCAN_FILE}")})
    if not scans:
        raise ConfigError(f"archive: no scans at {place}")
    found, root = _files_of(files, scans, _fixed_part(place))
    now = {posixpath.relpath(_rooted(path), root): (path, _stamp(details)) for path, details in found.items()}
    targets = {name: path_inside(copies, name) for name in now}
    before = _copied_before(copies)
    changed = [path for name, (path, stamp) in now.items() if before.get(name) != stamp]
    _check_room(copies, sum(int(found[path].get("size") or 0) for path in changed))
    for name in before.keys() - now.keys():
        path_inside(copies, name).unlink(missing_ok=True)
    kept = {}
    for name, (path, stamp) in now.items():
        target = targets[name]
        if before.get(name) != stamp or not target.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            files.get_file(path, str(target))
        kept[name] = stamp
    if kept != before:
        write_json(copies / COPIES_FILE, kept)


def _check_room(folder: Path, needed: int) -> None:
    """Check that a disk has room for some bytes, before they are copied: entries of a ZIP can claim any size."""
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.is_dir())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise ConfigError(f"archive: its copies take {needed / 1e9:.1f} GB, {there} has room for {free / 1e9:.1f} GB")


def _copied_before(copies: Path) -> dict[str, str]:
    """The copies that are there, with what changes with their originals; none where that is not recorded."""
    try:
        before = json.loads((copies / COPIES_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return before if isinstance(before, dict) else {}


def _fixed_part(place: str) -> str:
    """The folder that a pattern does not leave."""
    fixed = re.split(f"[{re.escape(PATTERN_SIGNS)}]", place, maxsplit=1)[0]
    return place if fixed == place else posixpath.dirname(fixed)


def _files_of(files: fsspec.AbstractFileSystem, scans: list[str], place: str) -> tuple[dict[str, dict[str, Any]], str]:
    """Every file of some scans with what is known of it, and the folder that holds all: the archive's root.

    The rigs beside or above the scans, and the responses that they name, are among them, where they lie in the archive
    too.
    """
    parents = [posixpath.dirname(posixpath.dirname(scan)) for scan in scans]
    limit = _common([place, *parents])
    found: dict[str, dict[str, Any]] = {}
    for scan in scans:
        found |= files.find(posixpath.dirname(scan), detail=True)
    for rig in _rigs(files, scans):
        if rig not in found and not rig.startswith("..") and _common([limit, rig]) == limit and files.exists(rig):
            found[rig] = files.info(rig)
            parents.append(posixpath.dirname(rig))
    return {str(path): details for path, details in found.items()}, _common(parents)


def _common(paths: list[str]) -> str:
    """The folder that holds all of some paths; some file systems begin theirs with a slash, some do not."""
    return posixpath.commonpath([posixpath.normpath(_rooted(path)) for path in paths])


def _rooted(path: str) -> str:
    """A path from the file system's root.

    Raises:
        FileFormatError: it goes up, as names in a ZIP can.
    """
    if ".." in path.split("/"):
        raise FileFormatError(path, "leads outside the archive")
    return f"/{path.lstrip('/')}"


def _stamp(details: dict[str, Any]) -> str:
    return repr([str(details[key]) for key in _STAMPS if key in details])


def _rigs(files: fsspec.AbstractFileSystem, scans: list[str]) -> Iterator[str]:
    """The paths of the rigs that scans name, and of the responses that these name."""
    for scan in scans:
        rig = _entries(files, scan).get("rig")
        if not isinstance(rig, str):
            continue
        path = posixpath.normpath(posixpath.join(posixpath.dirname(scan), rig))
        yield path
        named = _entries(files, path).get("response")
        for name in (named.get(camera) for camera in CAMERAS) if isinstance(named, dict) else ():
            if isinstance(name, str):
                yield posixpath.normpath(posixpath.join(posixpath.dirname(path), name))


def _entries(files: fsspec.AbstractFileSystem, path: str) -> dict[str, Any]:
    """The entries of a YAML file; none where it is reported when the scan is read."""
    if path.startswith("..") or not files.exists(path) or (files.info(path).get("size") or 0) > YAML_BYTES:
        return {}
    try:
        values = parse_yaml(files.cat_file(path).decode("utf-8"), path)
    except (UnicodeDecodeError, FileFormatError):
        return {}
    return values if isinstance(values, dict) else {}
