"""Writing aside and renaming when complete: a final name never holds half a result."""

import errno
import glob
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lsvision.errors import FileFormatError, WriteError

_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))  # no quotas on some platforms


@contextmanager
def naming_full_disk(target: Path | str) -> Iterator[None]:
    """Raise a ``WriteError`` that names ``target`` where the disk is full: the system's own error names nothing."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.errno in _FULL:
            raise WriteError(f"{target}: cannot be written: {os.strerror(error.errno)}") from error
        raise


@contextmanager
def partial_file(target: Path | str) -> Iterator[Path]:
    """Yield a hidden path beside ``target`` to write to; it takes the target's name on success, else it is removed.

    A link in the target's place is replaced: what it leads to, anywhere, is not written to.

    Raises:
        WriteError: the disk is full.
    """
    target = Path(target)
    target = target.parent.resolve() / target.name
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = _hidden_sibling(target)
    try:
        with naming_full_disk(target):
            yield partial
            partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def partial_folder(target: Path | str, *, marker: str) -> Iterator[Path]:
    """Yield a hidden folder beside ``target`` to fill; it takes the target's name on success, else it is removed.

    Args:
        target: final folder. An existing one is replaced only where nothing else can be lost by it.
        marker: name of a file that every folder of this kind holds; only such a folder is replaced.

    Raises:
        FileFormatError: ``target`` exists, is not empty and does not hold ``marker``.
        WriteError: the disk is full.
    """
    target = Path(target).resolve()
    check_replaceable(target, marker)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = _hidden_sibling(target)
    partial.mkdir()
    try:
        with naming_full_disk(target):
            yield partial
            _take_over(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def check_replaceable(target: Path, marker: str) -> None:
    """Check that nothing else can be lost where ``target`` is replaced; see ``partial_folder``.

    Raises:
        FileFormatError: ``target`` exists, is not empty and does not hold ``marker``.
    """
    if target.exists() and not (target.is_dir() and ((target / marker).is_file() or not any(target.iterdir()))):
        raise FileFormatError(target, f"expected a new or empty folder, or one with {marker} to replace")


def replace_folder(source: Path | str, target: Path | str, *, marker: str) -> None:
    """Give a finished folder its final name on the same file system; what ``target`` may hold: see ``partial_folder``.

    Raises:
        FileFormatError: ``target`` exists, is not empty and does not hold ``marker``.
    """
    target = Path(target).resolve()
    check_replaceable(target, marker)
    target.parent.mkdir(parents=True, exist_ok=True)
    _take_over(Path(source), target)


def remove_partial_siblings(target: Path | str) -> None:
    """Remove the partial results of killed writers beside ``target``; no other process may be writing it."""
    target = Path(target).resolve()
    for partial in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        shutil.rmtree(partial, ignore_errors=True)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file, UTF-8, in one step."""
    with partial_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _hidden_sibling(target: Path) -> Path:
    # Beside the target, so that the rename stays within one file system; unique, so that two writers never meet.
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")


def _take_over(partial: Path, target: Path) -> None:
    if not target.exists():
        partial.rename(target)
        return
    retired = _hidden_sibling(target)
    target.rename(retired)
    try:
        os.rename(partial, target)
    except OSError:
        retired.rename(target)
        raise
    shutil.rmtree(retired)
