"""Tests of all combinations of some values, of which a few are quick."""

import itertools
from collections.abc import Sequence

import pytest


def crossed(names: str, *values: Sequence) -> pytest.MarkDecorator:
    """Parametrise a test by all combinations; those on a diagonal are quick, and every value is in one of them.

    Of three choices of two values the quick combinations hold every pair of values.
    """
    shortest = min(map(len, values))
    cases = []
    for places in itertools.product(*(range(len(each)) for each in values)):
        marks = [] if sum(places) % shortest == 0 else [pytest.mark.slow]
        cases.append(pytest.param(*(each[at] for each, at in zip(values, places, strict=True)), marks=marks))
    return pytest.mark.parametrize(names.split(), cases)
