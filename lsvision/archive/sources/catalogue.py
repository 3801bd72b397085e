"""Finding the scans of an archive: below a folder, in a list, or by a pattern."""

import errno
import glob
import os
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lsvision.errors import ConfigError, FileFormatError
from lsvision.io.formats.scan import FILE_KEYS, SCAN_FILE
from lsvision.io.formats.scan_files import response_files
from lsvision.io.formats.validation import on_one_line, read_yaml
from lsvision.io.inside import path_inside

PATTERN_SIGNS = "*?["
COPIES_FILE = ".copied.json"  # in a folder of copies, what they are copies of

_CONTROL = ("Cc", "Zl", "Zp")  # Unicode's categories of control characters and of ends of lines and paragraphs

_Place = tuple[Path, str | None]


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
        ConfigError: there is no such folder or file, or it is no list.
    """
    root, places = _places(archive, skip)
    seen: set[Path] = set()
    found = []
    # A folder that several links lead to goes by its own name, where that is in the archive too.
    for place, problem in sorted(
        places, key=lambda item: (os.path.realpath(item[0]) != str(item[0].absolute()), item[0])
    ):
        real = place if problem else Path(os.path.realpath(place))
        if real not in seen:
            seen.add(real)
            found.append(_found(place, root, problem))
    return sorted(_with_own_names(found), key=lambda item: item.key)


def _places(archive: str, skip: Path | None) -> tuple[Path, Iterator[_Place]]:
    """The root of an archive, and the places of its scans."""
    path = Path(archive)
    if os.path.isdir(path):
        return path, _walk(path, skip.resolve() if skip else None)
    if os.path.isfile(path):
        places = _read_list(path)
    elif any(sign in archive for sign in PATTERN_SIGNS):
        places = [Path(match) for match in glob.glob(archive, recursive=True) if Path(match, SCAN_FILE).is_file()]
    else:
        raise ConfigError(f"archive: no such folder, list or pattern: {on_one_line(path)}")
    places = [_without_parents(place) for place in places]
    return _common_root(places), ((place, None) for place in places)


def _read_list(path: Path) -> list[Path]:
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors on Windows put a mark before it
    except UnicodeDecodeError as error:
        raise ConfigError(f"archive: {path}: expected a list as UTF-8 text, got byte {error.start}") from None
    except OSError as error:
        raise ConfigError(f"archive: {path}: {_in_words(error)}") from None
    lines = [line.strip() for line in text.splitlines()]
    if any("\0" in line for line in lines):
        raise ConfigError(f"archive: {path}: expected a list of folders, got null characters")
    return [path.parent / line for line in lines if line]


def _without_parents(place: Path) -> Path:
    """A place named without ``..``, so that its product lies where its name says."""
    return Path(os.path.realpath(place)) if ".." in place.parts else place


def _found(place: Path, root: Path, problem: str | None) -> Found:
    """A place with its key, and what is wrong with its name."""
    key, path = _key(place, root), place.absolute()
    if (fault := name_problem(f"{key} {path}")) is not None:
        return Found(on_one_line(key), Path(on_one_line(path)), problem or fault)
    if any(part.casefold().endswith(".zarr") for part in Path(key).parts[:-1]):
        problem = problem or "lies in a folder whose name ends in .zarr, as those of products do"
    if Path(key).parts[:1] == (".work",):
        problem = problem or "lies in a folder .work, where unfinished products are kept"
    return Found(key, path, problem or _problem_of_copy(place, root))


def name_problem(name: str) -> str | None:
    """What is wrong with a name that no terminal, ledger or other program could show as it is."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return "its name is not UTF-8; rename it"
    if any(unicodedata.category(sign) in _CONTROL for sign in name):
        return "its name has control characters; rename it"
    return None


def _problem_of_copy(place: Path, root: Path) -> str | None:
    """Whether a scan of a copied archive names files that are none of the archive's."""
    if not (root / COPIES_FILE).is_file():
        return None
    try:
        entries = read_yaml(place / SCAN_FILE)
    except FileFormatError:
        return None  # reported where the scan is read
    named = entries if isinstance(entries, Mapping) else {}
    for key in FILE_KEYS:
        try:
            path_inside(root, place / str(named.get(key, "")))
        except FileFormatError:
            return f"{SCAN_FILE}: {key}: leads outside the archive"
    rig = place / str(named.get("rig", ""))
    for file in response_files(rig):
        try:
            path_inside(root, file)
        except FileFormatError:
            return f"{rig.name}: response: leads outside the archive"
    return None


def _with_own_names(found: list[Found]) -> Iterator[Found]:
    """Scans whose products would take each other's place on some file system are at fault, each of them."""
    count = Counter(_folded(item.key) for item in found)
    for item in found:
        same = count[_folded(item.key)] > 1
        problem = "another scan's name differs in nothing but case or Unicode form; rename one"
        yield replace(item, problem=item.problem or problem) if same else item


def _folded(key: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", key).casefold())


def _walk(root: Path, skip: Path | None) -> Iterator[_Place]:
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
