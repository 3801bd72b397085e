from dataclasses import dataclass
from typing import Literal

import pytest

from lsvision.errors import ConfigError
from lsvision.experiments.settings import RunSettings, build_settings, settings_sha256


@dataclass(frozen=True)
class Inner:
    kind: Literal["near", "far"] = "near"
    span: tuple[float, float] = (0.0, 1.0)
    pitch: float | None = None


@dataclass(frozen=True, kw_only=True)
class Outer(RunSettings):
    inner: Inner
    scans: list[str]


GOOD = {"name": "outer", "inner": {"kind": "far", "span": [1, 2.5], "pitch": None}, "scans": ["a"]}


def test_values_become_dataclasses_with_tuples_and_defaults():
    assert build_settings(Outer, GOOD) == Outer(name="outer", inner=Inner("far", (1, 2.5), None), scans=["a"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner": {"kind": "nigh"}}, r"inner\.kind: expected near or far, got 'nigh'"),
        ({"inner": {"knd": "near"}}, r"knd: unknown option"),
        ({"inner": {"pitch": "wide"}}, r"inner\.pitch: expected float or NoneType, got 'wide'"),
        ({"scans": "a"}, r"scans: expected"),
        ({"spam": 1}, r"spam: unknown option of Outer"),
    ],
)
def test_a_wrong_option_is_named(change, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(Outer, {**GOOD, **change})


def test_a_missing_option_is_named():
    with pytest.raises(ConfigError, match="scans: missing"):
        build_settings(Outer, {"name": "outer", "inner": {}})


def test_hash_follows_every_value():
    one = build_settings(Outer, GOOD)
    other = build_settings(Outer, {**GOOD, "inner": {"kind": "far", "span": [1, 2.5000001]}})
    assert settings_sha256(one) == settings_sha256(build_settings(Outer, GOOD)) != settings_sha256(other)
