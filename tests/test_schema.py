import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import pytest
from pydantic import ValidationError

from lsvision.errors import ConfigError
from lsvision.schema import (
    Checked,
    Interval,
    NonNegative,
    OddInt,
    OptionError,
    Percent,
    Positive,
    PositiveInt,
    PositiveOrInfinite,
    Says,
    Wavelengths,
    build,
    default_values,
    option_fault,
)


@dataclass(frozen=True)
class Point(Checked):
    x: float
    y: NonNegative = 0.0


@dataclass(frozen=True)
class Sample(Checked):
    rows: PositiveInt = 1
    pitch: Positive | None = None
    sigma: PositiveOrInfinite = math.inf
    span: Interval = (-1.0, 1.0)
    block: OddInt = 5
    share: Percent = 5
    kind: Literal["near", "far"] = "near"
    flag: bool = False
    waves: Wavelengths = (1.0,)
    point: Point = field(default_factory=lambda: Point(0.0))
    points: list[Point] = field(default_factory=list)
    named: dict[str, list[Point]] = field(default_factory=dict)
    day: Annotated[str, Says("a day")] = field(default="1 May", metadata={"key": "from"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "far" and self.flag:
            raise self.fault("flag", "expected false where kind is far, got true")


def test_plain_data_become_dataclasses_tuples_and_floats() -> None:
    data = {"pitch": 3, "span": [1, 2], "points": [{"x": 1}], "named": {"a": [{"x": 2, "y": 1}]}, "from": "2 May"}
    sample = build(Sample, data, option_fault)
    expected = Sample(pitch=3.0, span=(1.0, 2.0), points=[Point(1.0)], named={"a": [Point(2.0, 1.0)]}, day="2 May")
    assert sample == expected
    assert isinstance(sample.pitch, float)
    assert isinstance(sample.points[0].x, float)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"rows": 0}, "rows: expected a whole number >= 1, got 0"),
        ({"rows": 3.0}, "rows: expected a whole number >= 1, got 3.0"),
        ({"rows": True}, "rows: expected a whole number >= 1, got True"),
        ({"rows": None}, "rows: expected a whole number >= 1, got null"),
        ({"pitch": "3"}, "pitch: expected a finite number > 0, got '3'"),
        ({"pitch": math.inf}, "pitch: expected a finite number > 0, got inf"),
        ({"sigma": math.nan}, "sigma: expected a number > 0, got nan"),
        ({"sigma": 0}, "sigma: expected a number > 0, got 0"),
        ({"span": [2, 1]}, "span: expected a list of two finite numbers, the lower one first, got [2, 1]"),
        ({"span": [1, "2"]}, "span[1]: expected a finite number, got '2'"),
        ({"block": 4}, "block: expected an odd whole number >= 1, got 4"),
        ({"share": 101}, "share: expected a whole number >= 0 and <= 100, got 101"),
        ({"kind": "nigh"}, "kind: expected 'near' or 'far', got 'nigh'"),
        ({"flag": 1}, "flag: expected true or false, got 1"),
        ({"waves": []}, "waves: expected a list that is not empty, got []"),
        ({"waves": [1, -2]}, "waves[1]: expected a finite number > 0, got -2"),
        ({"point": {}}, "point.x: missing"),
        ({"point": {"xx": 1}}, "point.x: missing (is 'xx' meant for it?)"),
        ({"point": 5}, "point: expected keys with values, got 5"),
        ({"points": [{"x": 1}, {"x": 1, "y": -1}]}, "points[1].y: expected a finite number >= 0, got -1"),
        ({"points": {"x": 1}}, "points: expected a list, got {'x': 1}"),
        ({"named": {"a": [{"x": None}]}}, "named.a[0].x: expected a finite number, got null"),
        ({"named": []}, "named: expected keys with values, got []"),
        ({"from": 5}, "from: expected a day, got 5"),
        ({"rwos": 5}, "rwos: unknown key; did you mean 'rows'?"),
        ({"point": {"x": 1, "spam": 2}}, "point.spam: unknown key; known keys: x, y"),
        ({"kind": "far", "flag": True}, "flag: expected false where kind is far, got true"),
        ({"kind": "x" * 99}, f"kind: expected 'near' or 'far', got '{'x' * 56}..."),
    ],
)
def test_an_entry_at_fault_is_named(data: dict, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        build(Sample, data, option_fault)
    assert str(raised.value) == message


def test_errors_are_those_of_the_caller() -> None:
    with pytest.raises(KeyError, match=r"file: point\.x"):
        build(Sample, {"point": {"x": "a"}}, lambda key, problem: KeyError(f"file: {key}: {problem}"))
    with pytest.raises(ConfigError, match=r"sample\.point\.x: expected"):
        build(Sample, {"point": {"x": "a"}}, option_fault, "sample")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sample(rows=0), "Sample.rows: expected a whole number >= 1, got 0"),
        (lambda: replace(Sample(), span=(1.0, 1.0)), r"Sample.span: expected a list of two .*, got \(1.0, 1.0\)"),
        (lambda: Sample(kind="far", flag=True), "Sample.flag: expected false where kind is far"),
        (lambda: Sample(points=[Point(1.0), 3]), r"Sample.points\[1\]: expected keys with values, got 3"),
    ],
)
def test_a_dataclass_made_in_python_holds_to_the_same_ranges(make: Callable, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        make()
    assert not isinstance(raised.value.__context__, ValidationError)  # which cannot be unpickled
    again = pickle.loads(pickle.dumps(raised.value))
    assert isinstance(again, OptionError)
    assert str(again) == str(raised.value)


def test_defaults_are_plain_and_what_has_none_is_marked() -> None:
    @dataclass(frozen=True)
    class Run(Checked):
        sample: Point
        runs: PositiveInt = 3
        listed: list[float] = field(default_factory=lambda: [1.0])

    assert default_values(Run) == {"sample": {"x": "???", "y": 0.0}, "runs": 3, "listed": [1.0]}
