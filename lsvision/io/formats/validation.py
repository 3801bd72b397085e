"""Reading plain data: every entry checked as it is taken, every error with the file and the key."""

import difflib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import torch
import yaml
from torch import Tensor

from lsvision.errors import FileFormatError


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
    """Plain data of a JSON file. NaN and infinity pass here, so that ``Fields`` can name the key that holds them.

    Raises:
        FileFormatError: not JSON.
    """
    try:
        return json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise FileFormatError(path, f"expected JSON: {error}") from error


class Fields:
    """The entries of one mapping in a file.

    Args:
        path: the file, named in errors.
        mapping: what was read; anything but a mapping is an error.
        prefix: where the mapping stands in the file, with a dot at its end ("motion.").
    """

    def __init__(self, path: Path, mapping: object, prefix: str = "") -> None:
        self.path, self._prefix = path, prefix
        if not isinstance(mapping, Mapping):
            raise FileFormatError(path, f"expected keys with values, got {_shown(mapping)}", prefix.rstrip(".") or None)
        self._mapping: Mapping[Any, object] = mapping
        self._known: list[str] = []

    def has(self, key: str) -> bool:
        """Whether an optional entry is there; null counts as absent."""
        self._known.append(key)
        return self._mapping.get(key) is not None

    def take(self, key: str) -> object:
        """An entry as it is; an error where it is missing."""
        self._known.append(key)
        if key not in self._mapping:
            near = difflib.get_close_matches(key, [str(name) for name in self._mapping], n=1)
            raise self.error(key, f"missing{f' (is {near[0]!r} meant for it?)' if near else ''}")
        return self._mapping[key]

    def text(self, key: str, *, empty: bool = False) -> str:
        """A text; an empty one only where ``empty`` allows it."""
        value = self.take(key)
        if not isinstance(value, str) or not (value or empty):
            raise self.error(key, f"expected text, got {_shown(value)}")
        return value

    def choice(self, key: str, *options: str) -> str:
        """A text that is one of ``options``."""
        value = self.take(key)
        if not isinstance(value, str) or value not in options:
            raise self.error(key, f"expected {' or '.join(map(repr, options))}, got {_shown(value)}")
        return value

    def flag(self, key: str) -> bool:
        """true or false."""
        value = self.take(key)
        if not isinstance(value, bool):
            raise self.error(key, f"expected true or false, got {_shown(value)}")
        return value

    def integer(self, key: str, *, at_least: int) -> int:
        """A whole number of at least ``at_least``."""
        value = self.take(key)
        if isinstance(value, bool) or not isinstance(value, int) or value < at_least:
            raise self.error(key, f"expected a whole number >= {at_least}, got {_shown(value)}")
        return value

    def number(self, key: str, *, above: float = -math.inf, at_least: float = -math.inf) -> float:
        """A finite number within a lower bound."""
        value = self.take(key)
        bound = f" > {above:g}" if above > -math.inf else f" >= {at_least:g}" if at_least > -math.inf else ""
        if not _is_finite(value) or value <= above or value < at_least:
            raise self.error(key, f"expected a finite number{bound}, got {_shown(value)}")
        return float(value)

    def tensor(self, key: str, *shape: int) -> Tensor:
        """Nested lists of finite numbers with the given shape, as float64."""
        return torch.tensor(self._numbers(key, self.take(key), shape), dtype=torch.float64)

    def section(self, key: str) -> "Fields":
        """A mapping within this one."""
        return Fields(self.path, self.take(key), f"{self._prefix}{key}.")

    def sections(self, key: str) -> list["Fields"]:
        """A list of mappings."""
        value = self.take(key)
        if not isinstance(value, list):
            raise self.error(key, f"expected a list, got {_shown(value)}")
        return [Fields(self.path, item, f"{self._prefix}{key}[{index}].") for index, item in enumerate(value)]

    def texts(self, key: str) -> dict[str, str]:
        """A mapping of names to texts; finite numbers are taken as text."""
        section = self.section(key)
        for name, value in section._mapping.items():
            if not isinstance(name, str) or not (isinstance(value, str) or _is_finite(value)):
                raise section.error(str(name), f"expected text or a finite number, got {_shown(value)}")
        return {str(name): str(value) for name, value in section._mapping.items()}

    def file(self, key: str) -> Path:
        """A file or folder that exists, by its path relative to this file."""
        target = self.path.parent / self.text(key)
        if not target.exists():
            raise self.error(key, f"no such file or folder: {target}")
        return target

    def finish(self) -> None:
        """Check that every entry was asked for: an unknown key is an error, never ignored."""
        unknown = [str(key) for key in self._mapping if key not in self._known]
        if unknown:
            near = difflib.get_close_matches(unknown[0], self._known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(dict.fromkeys(self._known))}"
            raise self.error(unknown[0], f"unknown key; {hint}")

    def error(self, key: str, problem: str) -> FileFormatError:
        """The error that names this file and a key of this mapping."""
        return FileFormatError(self.path, problem, f"{self._prefix}{key}")

    def _numbers(self, key: str, value: object, shape: tuple[int, ...]) -> Any:
        if not shape:
            if not _is_finite(value):
                raise self.error(key, f"expected a finite number, got {_shown(value)}")
            return float(value)
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != shape[0]:
            raise self.error(key, f"expected a list of {shape[0]}, got {_shown(value)}")
        return [self._numbers(f"{key}[{index}]", item, shape[1:]) for index, item in enumerate(value)]


def _is_finite(value: object) -> TypeGuard[int | float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond the range of float64
        return False


def _shown(value: object) -> str:
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
