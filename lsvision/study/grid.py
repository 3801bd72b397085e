"""The grid of a study: conditions with all combinations of the values that are varied."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

from lsvision.errors import ConfigError
from lsvision.schema import Checked, OptionError

Conditions = TypeVar("Conditions", bound=Checked)


def study_points(base: Conditions, axes: Mapping[str, Sequence[float | int | str] | None]) -> list[Conditions]:
    """The grid of all axes, the last one fastest, over the base's conditions; an axis of None stays at its value.

    Raises:
        ConfigError: an axis that is no condition, is empty, or holds a value that the condition cannot have.
    """
    conditions: Any = base  # a frozen dataclass, as all checked ones
    known = [item.name for item in fields(conditions)]
    varied = {name: values for name, values in axes.items() if values is not None}
    for name, values in varied.items():
        if name not in known:
            raise ConfigError(f"axes.{name}: unknown; expected one of {', '.join(known)}")
        if not values:
            raise ConfigError(f"axes.{name}: the list is empty")
    combinations: list[dict[str, Any]] = [
        dict(zip(varied, values, strict=True)) for values in itertools.product(*varied.values())
    ]
    try:
        return [replace(conditions, **values) for values in combinations]
    except OptionError as error:
        raise ConfigError(f"axes.{error.key}: {error.problem}") from error
