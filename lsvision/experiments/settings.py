"""The options of a run as dataclasses: made once, at the edge, and checked key by key."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TypeVar

from lsvision.schema import Checked, PositiveInt, Seed, Text, build, option_fault


@dataclass(frozen=True, kw_only=True)
class RunSettings(Checked):
    """What every experiment has: its name, the seed of all random numbers and the threads torch may use."""

    name: Text
    seed: Seed = 0
    threads: PositiveInt = 2


Settings = TypeVar("Settings", bound=RunSettings)


def build_settings(schema: type[Settings], config: Mapping) -> Settings:
    """Make the dataclass of a resolved configuration.

    Raises:
        ConfigError: an unknown key, a missing one, or a value of the wrong type or out of range; names the key.
    """
    return build(schema, config, option_fault)


def settings_sha256(settings: RunSettings) -> str:
    """Hash of every value of a configuration."""
    return hashlib.sha256(json.dumps(asdict(settings), sort_keys=True).encode()).hexdigest()
