"""The one way in which JSON is written: never with NaN or infinity, which JSON does not have."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

from lsvision.io.atomic import write_text


def write_json(path: Path | str, data: object, *, strict: bool = False) -> None:
    """Write plain data as JSON, UTF-8, in one step; a number that is not finite becomes null.

    Args:
        strict: such a number is an error instead, and nothing is written.

    Raises:
        ValueError: the data hold NaN or infinity, with ``strict``.
    """
    plain = data if strict else finite_or_null(data)
    write_text(path, json_text(plain, indent=2) + "\n")


def json_text(data: object, *, indent: int | None = None) -> str:
    """Plain data as JSON.

    Raises:
        ValueError: the data hold NaN or infinity.
    """
    return json.dumps(data, indent=indent, allow_nan=False, ensure_ascii=False)


def finite_or_null(data: object) -> object:
    """The same data with None for every float that is NaN or infinite."""
    if isinstance(data, Mapping):
        return {name: finite_or_null(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite_or_null(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
