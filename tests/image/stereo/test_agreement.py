"""What the right camera says: claims, occlusion and filling, by hand and against loops."""

import torch

from lsvision.image.stereo.agreement import agreeing, fill_from_background, occluded

NAN = float("nan")


def test_the_better_of_two_claims_stays():
    # Columns 4 and 6 both claim column 2 of the right image.
    disparity = torch.tensor([[NAN, NAN, NAN, NAN, 2.0, NAN, 4.0]])
    cost = torch.tensor([[0.0, 0, 0, 0, 3.0, 0, 9.0]])
    assert agreeing(disparity, cost, 1.0)[0].isfinite().nonzero().tolist() == [[4]]
    assert agreeing(disparity, cost, 2.0)[0].isfinite().nonzero().tolist() == [[4], [6]]


def test_claims_equal_a_loop():
    disparity = torch.randint(-9, 30, (12, 40)) + 0.4 * torch.rand(12, 40)
    disparity[torch.rand(12, 40) < 0.2] = NAN
    cost = torch.randint(0, 256, (12, 40)).float()
    kept = agreeing(disparity, cost, 1.0).isfinite()
    for line in range(12):
        for u in range(40):
            d = disparity[line, u]
            partner = u - int(d.round()) if d.isfinite() else -1
            if not 0 <= partner < 40:
                assert not kept[line, u]
                continue
            rivals = [
                w for w in range(40) if disparity[line, w].isfinite() and w - disparity[line, w].round() == partner
            ]
            best = min(rivals, key=lambda w: (float(cost[line, w]), float(disparity[line, w].round())))
            assert kept[line, u] == bool((d - disparity[line, best].round()).abs() <= 1.0)


def test_filling_by_hand():
    disparity = torch.tensor([[NAN, 5.0, NAN, NAN, 2.0, NAN], [NAN] * 6, [7.0, NAN, 9.0, NAN, NAN, NAN]])
    filled = fill_from_background(disparity)
    expected = torch.tensor([[5.0, 5, 2, 2, 2, 2], [5.0] * 6, [7.0, 7, 9, 9, 9, 9]])
    assert torch.equal(filled, expected)
    assert fill_from_background(torch.full((2, 3), NAN)) is None


def test_occlusion_and_mismatch_are_separated():
    # A surface of disparity 6 from column 20 on before a ground of 0: it hides columns 14..19 from the right camera.
    disparity = torch.zeros(1, 40)
    disparity[:, 20:] = 6.0
    disparity[:, 14:20] = NAN
    disparity[:, 4:7] = NAN  # nothing hides these
    hidden = occluded(disparity)
    assert hidden[0].nonzero()[:, 0].tolist() == list(range(14, 20))
    assert not occluded(torch.full((1, 5), NAN)).any()
