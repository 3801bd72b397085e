"""Lists of different lengths against a loop."""

import torch

from lsvision.image.ragged import ragged_range


def test_equals_a_loop():
    counts = torch.randint(0, 4, (20,))
    which, place = ragged_range(counts)
    expected = [(i, k) for i, count in enumerate(counts.tolist()) for k in range(count)]
    assert list(zip(which.tolist(), place.tolist(), strict=True)) == expected


def test_no_entries():
    for counts in (torch.zeros(3, dtype=torch.long), torch.zeros(0, dtype=torch.long)):
        which, place = ragged_range(counts)
        assert len(which) == len(place) == 0
