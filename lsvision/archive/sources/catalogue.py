"""Finding the scans of an archive: below a folder, in a list, or by a pattern."""

import errno
import glob
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lsvision.errors import ConfigError
from lsvision.io.formats.scan import SCAN_FILE

PATTERN_SIGNS = "*?["


@dataclass(frozen=True)
class Found:
    """A place of the archive: a scan, or the problem that keeps it from being read.

    ``key`` names the scan within the archive, its path from the archive's root; its product lies at the same path below
    the output.
    """

    key: str
    path: Path
    problem: str | None = None


def find_scans(archive: str, skip: Path | None = None) -> list[Found]:
    """All scans of an archive, each folder once, in natural reading order of their keys.

    Args:
        archive: a folder that holds the scans, however deep; a text file with the path of one scan folder per line,
            relative to the file's folder; or a pattern with ``*``, ``?``, ``[..]`` or ``**`` that scan folders match.
        skip: a folder to leave out, where products are written.

    Raises:
        ConfigError: there is no such folder or file.
    """
    path = Path(archive)
    if path.is_dir():
        places = _walk(path, skip.resolve() if skip else None)
        root = path
    elif path.is_file():
        listed = [path.parent / line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        places, root = ((place, None) for place in listed), _common_root(listed)
    elif any(sign in archive for sign in PATTERN_SIGNS):
        matched = [Path(match) for match in glob.glob(archive, recursive=True) if Path(match, SCAN_FILE).is_file()]
        places, root = ((place, None) for place in matched), _common_root(matched)
    else:
        raise ConfigError(f"archive: no such folder, list or pattern: {archive}")
    seen: set[Path] = set()
    found = []
    # A folder that several links lead to goes by its own name, where that is in the archive too.
    for place, problem in sorted(
        places, key=lambda item: (os.path.realpath(item[0]) != str(item[0].absolute()), item[0])
    ):
        real = place if problem else Path(os.path.realpath(place))
        if real not in seen:
            seen.add(real)
            found.append(Found(_key(place, root), place.absolute(), problem))
    return sorted(found, key=lambda item: item.key)


def _walk(root: Path, skip: Path | None) -> Iterator[tuple[Path, str | None]]:
    """Scan folders below a folder, and places that cannot be read; links are followed, but never round in circles."""
    pending: list[tuple[Path, tuple[Path, ...]]] = [(root, (root.resolve(),))]
    while pending:
        folder, above = pending.pop()
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError as error:
            yield folder, _in_words(error)
            continue
        if any(entry.name == SCAN_FILE for entry in entries):
            yield folder, None
            continue
        for entry in entries:
            if entry.name.startswith(".") or entry.name.endswith(".zarr"):
                continue
            place = Path(entry.path)
            try:
                if not entry.is_dir():
                    _check_link(entry)
                    continue
                real = place.resolve(strict=True)
            except OSError as error:
                yield place, _in_words(error)
                continue
            if entry.is_symlink() and real in above:
                yield place, f"a symbolic link that loops back to {real}"
            elif real != skip:
                pending.append((place, (*above, real)))


def _check_link(entry: os.DirEntry[str]) -> None:
    if entry.is_symlink():
        os.stat(entry.path)  # raises where the link leads in circles or nowhere


def _in_words(error: OSError) -> str:
    if error.errno == errno.ELOOP:
        return "a symbolic link that loops back to itself"
    return f"cannot be read: {error.strerror}"


def _common_root(places: list[Path]) -> Path:
    if not places:
        return Path()
    return Path(os.path.commonpath([place.absolute().parent for place in places]))


def _key(place: Path, root: Path) -> str:
    """Path below the root, and the folder's own name where it is the root."""
    below = place.absolute().relative_to(root.absolute()).as_posix()
    return place.resolve().name if below == "." else below
