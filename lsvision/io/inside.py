"""Paths that data supplies, kept in the folder they belong to."""

from pathlib import Path

from lsvision.errors import FileFormatError


def path_inside(folder: Path, name: Path | str) -> Path:
    """The path of a name below a folder.

    Links are followed before it is compared, so that neither ``..`` nor an absolute name, another drive or a link leads
    out of the folder.

    Raises:
        FileFormatError: it lies elsewhere, or is no path.
    """
    target = folder / name
    try:
        inside = target.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # links in a circle, a null character
        inside = False
    if not inside:
        raise FileFormatError(target, f"leads outside {folder}")
    return target
