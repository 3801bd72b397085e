"""Reading plain data: every entry is checked, and every error names the file and the key."""

import json
from pathlib import Path
from typing import TypeVar

import yaml

from lsvision.errors import FileFormatError
from lsvision.schema import build

T = TypeVar("T")

# A vector and a matrix of three, as nested lists of finite numbers.
Triple = tuple[float, float, float]
Matrix = tuple[Triple, Triple, Triple]


def read_text(path: Path) -> str:
    """Text of a UTF-8 file.

    Raises:
        FileFormatError: there is no such file, or it is not text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileFormatError(path, "no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(path, f"cannot be read as text: {error}") from error


def read_yaml(path: Path) -> object:
    """Plain data of a YAML file; nothing in it is ever executed.

    Raises:
        FileFormatError: not YAML, or YAML with tags that ask for objects.
    """
    try:
        return yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise FileFormatError(path, f"expected plain YAML: {' '.join(str(error).split())}") from error


def read_json(path: Path) -> object:
    """Plain data of a JSON file. NaN and infinity pass here, so that ``read_entries`` can name their key.

    Raises:
        FileFormatError: not JSON.
    """
    try:
        return json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
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
    return build(schema, data, lambda key, problem: FileFormatError(path, problem, key or None), where)


def named_file(path: Path, key: str, name: str) -> Path:
    """The file or folder that an entry names, relative to the file that holds the entry.

    Raises:
        FileFormatError: it does not exist.
    """
    target = path.parent / name
    if not target.exists():
        raise FileFormatError(path, f"no such file or folder: {target}", key)
    return target
