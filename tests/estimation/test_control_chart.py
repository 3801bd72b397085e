"""Changes of a quantity that is measured again and again."""

import math

import pytest
import torch
from scipy import stats

from lsvision.estimation import ChangeRule, changes, control_chart
from lsvision.estimation.control_chart import MOST_SCORE, normal_score

RULE = ChangeRule()


def drawn(archives: int, scans: int = 60, seed: int = 0) -> torch.Tensor:
    return torch.randn(archives, scans, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def by_hand(values: list[float], learned: int, allowance: float) -> list[float]:
    """The upper sum, value by value, of a series without outliers."""
    upper, sums = 0.0, [0.0] * learned
    for count in range(learned, len(values)):
        before = values[:count]
        mean = sum(before) / count
        sigma = math.sqrt(sum((value - mean) ** 2 for value in before) / (count - 1))
        t = math.sqrt(count / (count + 1)) * (values[count] - mean) / sigma
        score = stats.norm.ppf(stats.t.cdf(t, count - 1))
        upper = max(0.0, upper + min(score, MOST_SCORE) - allowance)
        sums.append(upper)
    return sums


def test_the_sums_are_those_of_hawkins_by_hand():
    values = drawn(1, 30, seed=5)[0].clamp(-1.5, 1.5)
    values[20:] += 0.5
    expected = torch.tensor(by_hand(values.tolist(), 8, 0.5), dtype=torch.float64)
    assert float((control_chart(values, 8, 0.5).upper - expected).abs().max()) < 0.05  # Wallace's approximation


def test_a_batch_equals_its_series():
    values = drawn(5)
    whole = control_chart(values, 8, 1.0).highest
    assert torch.equal(whole, torch.stack([control_chart(one, 8, 1.0).highest for one in values]))


@pytest.mark.parametrize("degrees", [7, 20, 50])
def test_normal_scores(degrees):
    t = torch.linspace(-4, 4, 41, dtype=torch.float64)
    expected = torch.from_numpy(stats.norm.ppf(stats.t.cdf(t.numpy(), degrees)))
    assert float((normal_score(t, degrees) - expected).abs().max()) < 0.03


def test_scale_and_level_do_not_matter_and_mirrored_series_mirror():
    values = drawn(20)
    chart, other, mirrored = (control_chart(item, 8, 1.0) for item in (values, 7.0 + 0.01 * values, -values))
    assert float((chart.upper - other.upper).abs().max()) < 1e-6
    assert torch.equal(chart.upper, mirrored.lower)


def test_a_change_is_found_where_it_begins_and_a_second_one_too():
    values = 0.1 * drawn(1, 60, seed=3)[0]
    values[20:] += 1.0
    values[45:] -= 2.0
    found = changes(values, RULE)
    assert [change.first for change in found] == [20, 45]
    assert [change.size for change in found] == [pytest.approx(1.0, abs=0.1), pytest.approx(-2.0, abs=0.2)]
    assert all(change.noticed - change.first <= 3 for change in found)


def test_one_odd_value_is_no_change_nor_a_change_below_the_tolerance():
    values = drawn(1, 60, seed=3)[0]
    values[30] += 100.0
    assert changes(values, RULE) == []
    values = 0.1 * drawn(1, 60, seed=4)[0]
    values[30:] += 1.0
    assert changes(values, RULE)
    assert changes(values, ChangeRule(least_size=1.5)) == []


def test_few_or_equal_values_show_nothing():
    assert changes(torch.zeros(0, dtype=torch.float64), RULE) == []
    assert changes(drawn(1, 8)[0], RULE) == []
    assert changes(torch.ones(60, dtype=torch.float64), RULE) == []
    with pytest.raises(ValueError, match="learned: expected at least 2"):
        control_chart(torch.zeros(5), 1, 1.0)


def test_false_alarms_are_as_few_as_stated_and_changes_are_found_in_time():
    """A fifth of a percent of series of 60 equal values alarm: one percent of archives of five signals."""
    beyond = control_chart(drawn(20000), RULE.learned, RULE.allowance).highest.amax(-1) > RULE.limit
    assert float(beyond.double().mean()) < 0.0025
    for start, size, share in ((12, 5.0, 0.9), (30, 4.0, 0.98)):
        values = drawn(2000, start + 5, seed=1)
        values[:, start:] += size
        seen = control_chart(values, RULE.learned, RULE.allowance).highest[:, start:].amax(-1) > RULE.limit
        assert float(seen.double().mean()) > share
