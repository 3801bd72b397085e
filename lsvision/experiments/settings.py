"""The configuration as dataclasses: converted once, at the edge, and checked key by key."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TypeVar

import dacite

from lsvision.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What every experiment has: its name, the seed of all random numbers and the threads torch may use."""

    name: str
    seed: int = 0
    threads: int = 2


Settings = TypeVar("Settings", bound=RunSettings)


def build_settings(schema: type[Settings], config: Mapping) -> Settings:
    """Convert a resolved configuration to its dataclass.

    Raises:
        ConfigError: an unknown key, a missing one or a value of the wrong type; names the key.
    """
    try:
        return dacite.from_dict(schema, config, dacite.Config(strict=True, cast=[tuple]))
    except dacite.WrongTypeError as error:
        expected = getattr(error.field_type, "__args__", None) or getattr(error.field_type, "__name__", "")
        raise ConfigError(f"{error.field_path}: expected {_in_words(expected)}, got {error.value!r}") from error
    except dacite.UnexpectedDataError as error:
        raise ConfigError(f"{', '.join(sorted(error.keys))}: unknown option of {schema.__name__}") from error
    except dacite.MissingValueError as error:
        raise ConfigError(f"{error.field_path}: missing") from error
    except dacite.DaciteError as error:
        raise ConfigError(str(error)) from error


def settings_sha256(settings: RunSettings) -> str:
    """Hash of every value of a configuration."""
    return hashlib.sha256(json.dumps(asdict(settings), sort_keys=True).encode()).hexdigest()


def _in_words(expected: object) -> str:
    if isinstance(expected, tuple):
        return " or ".join(
            value if isinstance(value, str) else getattr(value, "__name__", "none") for value in expected
        )
    return str(expected)
