"""Reading plain data: every entry is checked, and every error names the file and the key."""

import io
import json
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from lsvision.errors import FileFormatError
from lsvision.io.formats.plain_yaml import load_plain_yaml
from lsvision.schema import build

T = TypeVar("T")

YAML_BYTES = 1 << 20  # of the largest YAML file that is read, in a few seconds
_MOST_BYTES = 1 << 28  # of any text: the encoder log of ten million lines

# A vector and a matrix of three, as nested lists of finite numbers.
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


def read_bytes(path: Path, most_bytes: int = _MOST_BYTES) -> bytes:
    """Content of a file.

    Args:
        most_bytes: size of the largest file that is read.

    Raises:
        FileFormatError: there is no such file, or it is too large, a device or a pipe.
    """
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            raise FileFormatError(path, "expected a file, got a folder, device or pipe")
        if state.st_size > most_bytes:
            raise FileFormatError(path, f"expected at most {most_bytes} bytes, got {state.st_size}")
        return path.read_bytes()
    except FileNotFoundError:
        raise FileFormatError(path, "no such file") from None
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror}") from error
    except ValueError as error:  # a null character in the name
        raise FileFormatError(path, f"cannot be read: {error}") from error


def read_text(path: Path, most_bytes: int = _MOST_BYTES) -> str:
    """Text of a UTF-8 file.

    Args:
        most_bytes: size of the largest file that is read.

    Raises:
        FileFormatError: as ``read_bytes``, or it is not text.
    """
    try:
        return io.TextIOWrapper(io.BytesIO(read_bytes(path, most_bytes)), encoding="utf-8").read()
    except UnicodeDecodeError as error:
        raise FileFormatError(path, f"cannot be read as text: no UTF-8 at byte {error.start}") from error


def read_yaml(path: Path) -> object:
    """Plain data of a YAML file; nothing in it is ever executed. See ``PlainLoader``.

    Raises:
        FileFormatError: not YAML, or YAML that asks for more than plain data.
    """
    return parse_yaml(read_text(path, YAML_BYTES), path)


def parse_yaml(text: str, path: Path | str) -> object:
    """Plain data of a YAML text.

    Args:
        path: where it comes from, for errors.

    Raises:
        FileFormatError: as ``read_yaml``.
    """
    try:
        return load_plain_yaml(text)
    except ValueError as error:
        raise FileFormatError(path, f"expected plain YAML: {error}") from error


def read_json(path: Path) -> object:
    """Plain data of a JSON file. NaN and infinity pass here, so that ``read_entries`` can name their key.

    Raises:
        FileFormatError: not JSON, or a key stands twice.
    """
    try:
        return json.loads(read_text(path), object_pairs_hook=_mapping)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"expected JSON: {error}") from error


def read_entries(schema: type[T], data: object, path: Path, where: str = "") -> T:
    """The entries of a mapping in a file, as the dataclass that describes them.

    An optional entry has the default None, so that null in the file counts as absent.

    Args:
        schema: the dataclass; its fields are the keys.
        data: what was read from ``path``.
        where: key of the mapping within the file ("motion"); empty for the whole file.

    Raises:
        FileFormatError: an entry is missing, unknown, of the wrong type or out of range.
    """
    if not where and not isinstance(data, Mapping):  # not ours: nothing of it is shown
        kind = {str: "text", list: "a list", type(None): "null"}.get(type(data), "a number")
        raise FileFormatError(path, f"expected keys with values, got {kind}")
    return build(schema, data, lambda key, problem: FileFormatError(path, problem, on_one_line(key) or None), where)


def named_file(path: Path, key: str, name: str) -> Path:
    """The file or folder that an entry names, relative to the file that holds the entry.

    Raises:
        FileFormatError: it does not exist, or is a device or a pipe.
    """
    target = path.parent / name
    try:
        mode = target.stat().st_mode
    except (OSError, ValueError):  # a null character, or a name that is too long
        raise FileFormatError(path, f"no such file or folder: {on_one_line(target)}", key) from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileFormatError(path, f"expected a file or folder, got a device or pipe: {target}", key)
    return target


def on_one_line(text: object) -> str:
    """A name, key or path as an error shows it: on one line, cut where it is long."""
    line = str(text).encode("utf-8", "backslashreplace").decode()
    line = "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in line[:400])
    return line if len(line) <= 300 else f"{line[:297]}..."


def _mapping(pairs: list[tuple[str, object]]) -> dict[str, object]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice[:40]!r} stands twice")
    return mapping
