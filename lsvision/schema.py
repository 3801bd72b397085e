"""The one checker of options and of the entries of files.

A frozen dataclass states on each field what it may hold: type, range, default. A ``Checked`` dataclass is checked
wherever it is made; ``build`` makes any dataclass from plain data and names the entry at fault. A number is finite
unless its annotation says otherwise; true and "3" are no numbers, 3.0 is no whole number, a list stands for a tuple.
"""

import difflib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, asdict, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, MinLen, Predicate
from pydantic import AllowInfNan, ConfigDict, TypeAdapter, ValidationError

from lsvision.errors import ConfigError


@dataclass(frozen=True)
class Says:
    """Part of an annotation: what it allows, in words, where type and bounds do not say it."""

    words: str


IS_ODD = Predicate(lambda value: value % 2 == 1)
RISES = Predicate(lambda interval: interval[0] < interval[1])

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
PositiveOrInfinite = Annotated[float, Gt(0), AllowInfNan(True)]
Scale = Annotated[float, Ge(1)]
AcuteAngle = Annotated[float, Gt(-90), Lt(90)]  # degrees
PositiveInt = Annotated[int, Ge(1)]
NonNegativeInt = Annotated[int, Ge(0)]
IntFrom2 = Annotated[int, Ge(2)]
OddInt = Annotated[int, Ge(1), IS_ODD, Says("an odd whole number >= 1")]
OddIntFrom3 = Annotated[int, Ge(3), IS_ODD, Says("an odd whole number >= 3")]
Share = Annotated[float, Ge(0), Le(1)]
Percent = Annotated[int, Ge(0), Le(100)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
Interval = Annotated[tuple[float, float], RISES, Says("a list of two finite numbers, the lower one first")]
Wavelengths = Annotated[tuple[Positive, ...], MinLen(1)]
Text = Annotated[str, MinLen(1)]

T = TypeVar("T")
# Makes the error about an entry from its dotted key and the problem.
Fault = Callable[[str, str], Exception]

REQUIRED = "???"  # stands for a value that has no default, as in Hydra
_CONFIG = ConfigDict(strict=True, allow_inf_nan=False)
_BOUNDS: dict[type, str] = {Gt: "> {0.gt}", Ge: ">= {0.ge}", Lt: "< {0.lt}", Le: "<= {0.le}"}
_KINDS: dict[object, str] = {
    bool: "true or false", str: "text", int: "a whole number", float: "a finite number",
    list: "a list", tuple: "a list", dict: "keys with values",
}  # fmt: skip


class OptionError(ConfigError):
    """A value that a field of a checked dataclass does not allow; names the dataclass and the field."""

    def __init__(self, owner: str, key: str, problem: str) -> None:
        super().__init__(f"{owner}.{key}: {problem}")
        self.owner, self.key, self.problem = owner, key, problem

    def __reduce__(self) -> tuple[type, tuple[str, ...]]:
        return type(self), (self.owner, self.key, self.problem)


def option_fault(key: str, problem: str) -> ConfigError:
    """The error about an option of a run, or an argument that is one."""
    return ConfigError(f"{key}: {problem}")


class Checked:
    """Base of frozen dataclasses whose fields are checked against their annotations whenever one is made.

    A rule between fields extends ``__post_init__`` and raises ``fault``.

    Raises:
        OptionError: a value that its annotation does not allow.
    """

    def __post_init__(self) -> None:
        schema: Any = type(self)
        for name, annotation in annotations_of(schema).items():
            object.__setattr__(self, name, check(annotation, getattr(self, name), name, self.fault))

    def fault(self, key: str, problem: str) -> OptionError:
        """The error about the value of a field."""
        return OptionError(type(self).__name__, key, problem)


@dataclass(frozen=True)
class Shape:
    """An annotation taken apart: the type without ``None`` and metadata, and its arguments."""

    kind: Any
    arguments: tuple[Any, ...]
    optional: bool
    metadata: tuple[object, ...]

    @property
    def is_dataclass(self) -> bool:
        """Whether a mapping of keys to values stands for it in plain data."""
        return isinstance(self.kind, type) and is_dataclass(self.kind)

    def item(self, index: int) -> Any:
        """Annotation of an element of a list or tuple."""
        return self.arguments[0 if self.kind is list or self.arguments[-1] is Ellipsis else index]

    @property
    def fixed_length(self) -> int | None:
        """Length of a tuple that has one."""
        return None if self.kind is not tuple or self.arguments[-1] is Ellipsis else len(self.arguments)


@cache
def shape_of(annotation: Any) -> Shape:
    """Take an annotation apart."""
    choices = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    present = [choice for choice in choices if choice is not NoneType]
    metadata: list[object] = []
    bare = present[0] if len(present) == 1 else Union[tuple(present)]  # noqa: UP007
    if get_origin(bare) is Annotated:
        bare, *metadata = get_args(bare)
    return Shape(get_origin(bare) or bare, get_args(bare), len(present) < len(choices), tuple(metadata))


@cache
def annotations_of(schema: Any) -> dict[str, Any]:
    """Annotations of a dataclass's fields, by name."""
    hints = get_type_hints(schema, include_extras=True)
    return {item.name: hints[item.name] for item in fields(schema)}


def check(annotation: Any, value: object, key: str, fault: Fault) -> Any:
    """Check a value and convert it as its annotation asks: lists to tuples, mappings to dataclasses, 3 to 3.0.

    Args:
        annotation: a scalar type, a dataclass, or lists, tuples and dictionaries of them, any of them ``Annotated``.
        key: where the value stands ("correction.strip_rows"). fault: makes the error.
    """
    shape = shape_of(annotation)
    if value is None and shape.optional:
        return None
    if shape.is_dataclass:
        return value if isinstance(value, shape.kind) else build(shape.kind, value, fault, key)
    converted: Any = value
    if shape.kind in (list, tuple) and isinstance(value, list | tuple) and shape.fixed_length in (None, len(value)):
        converted = shape.kind(check(shape.item(i), item, f"{key}[{i}]", fault) for i, item in enumerate(value))
    elif shape.kind is dict and isinstance(value, Mapping):
        converted = {name: check(shape.arguments[1], item, f"{key}.{name}", fault) for name, item in value.items()}
    # Raised outside of the handler: an error that keeps pydantic's as its context cannot travel between processes.
    with suppress(ValidationError):
        return _adapter(annotation).validate_python(converted)
    hint = f"; write [{shown(value)[1:-1]}] for a list of one" if shape.kind is list and isinstance(value, str) else ""
    raise fault(key, f"expected {in_words(annotation)}, got {shown(value)}{hint}")


def build(schema: type[T], data: object, fault: Fault, where: str = "") -> T:
    """Make a dataclass from plain data.

    Args:
        schema: the dataclass; fields without a default are required. Metadata of a field may give it another ``key``.
        data: what was read; anything but a mapping is an error.
        fault: makes the error. where: key of the mapping itself ("motion"); empty for the whole.
    """
    if not isinstance(data, Mapping):
        raise fault(where, f"expected keys with values, got {shown(data)}")
    prefix = f"{where}." if where else ""
    hints = annotations_of(cast(Any, schema))
    known = {item.metadata.get("key", item.name): item for item in fields(cast(Any, schema))}
    values = {}
    for key, item in known.items():
        if key in data:
            values[item.name] = check(hints[item.name], data[key], prefix + key, fault)
        elif is_required(item):
            near = difflib.get_close_matches(key, map(str, data), n=1)
            raise fault(prefix + key, f"missing{f' (is {near[0]!r} meant for it?)' if near else ''}")
    for key in data:
        if key not in known:
            raise fault(f"{prefix}{key}", f"unknown key; {near_hint(str(key), known)}")
    try:
        return schema(**values)
    except OptionError as error:
        raise fault(prefix + error.key, error.problem) from None


def default_values(schema: type) -> dict[str, Any]:
    """The defaults of a dataclass, and of those within it, as plain data; ``REQUIRED`` where there is none."""
    values = {}
    for item in fields(schema):
        shape = shape_of(annotations_of(schema)[item.name])
        if not is_required(item):
            default: Any = item.default if item.default_factory is MISSING else item.default_factory()
            values[item.name] = asdict(default) if shape.is_dataclass and default is not None else default
        else:
            values[item.name] = default_values(shape.kind) if shape.is_dataclass else REQUIRED
    return values


def is_required(item: Field) -> bool:
    """Whether a field has no default."""
    return item.default is MISSING and item.default_factory is MISSING


def in_words(annotation: Any) -> str:
    """What an annotation allows."""
    shape = shape_of(annotation)
    says = [item.words for item in shape.metadata if isinstance(item, Says)]
    return says[0] if says else _kind_in_words(shape)


def shown(value: object) -> str:
    """A value as an error shows it, cut where it is long."""
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


@cache
def _adapter(annotation: Any) -> TypeAdapter:
    return TypeAdapter(annotation, config=_CONFIG)


def _kind_in_words(shape: Shape) -> str:
    if shape.kind is Literal:
        return _either([repr(value) for value in shape.arguments])
    if shape.kind in (Union, UnionType):
        return _either([in_words(choice) for choice in shape.arguments])
    if shape.fixed_length is not None:
        return f"a list of {shape.fixed_length}"
    kind = "a number" if AllowInfNan(True) in shape.metadata else _KINDS.get(shape.kind, "keys with values")
    if shape.kind in (list, tuple) and MinLen(1) in shape.metadata:
        return f"{kind} that is not empty"
    bounds = [_BOUNDS[type(item)].format(item) for item in shape.metadata if type(item) in _BOUNDS]
    return f"{kind} {' and '.join(bounds)}".rstrip()


def _either(choices: list[str]) -> str:
    return " or ".join([", ".join(choices[:-1]), choices[-1]] if len(choices) > 1 else choices)


def near_hint(unknown: str, known: Iterable[str]) -> str:
    """What may have been meant by an unknown name."""
    near = difflib.get_close_matches(unknown, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
