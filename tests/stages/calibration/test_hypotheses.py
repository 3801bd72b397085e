"""The cause of contradicting boards is named, and sound boards have none: in 200 sets, in a few where it is fast."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

from lsvision.stages.calibration.along_scan import COMPONENTS
from lsvision.stages.calibration.causes import NONE, candidates
from lsvision.stages.calibration.departures import (
    KINDS,
    Placement,
    ReducedCorners,
    corner_rows,
    placement,
    residual_and_jacobian,
)
from lsvision.stages.calibration.hypotheses import Assumed, explain
from tests.stages.calibration.boards import SIGMA, simulate
from tests.stages.calibration.contradictions import (
    DETECTED,
    EIGHT,
    THREE,
    bent,
    drifting_last,
    faster,
    noisier_than_stated,
    other_size,
    shaken,
    sound,
)

PRIOR = Assumed(0.05)
SLOW = 200
FAST = 4


def posed(corners):
    problem, start = corners.problem()
    return problem, ReducedCorners.of(problem).scaled(), placement(problem, start)


def named(corners, assumed=PRIOR):
    """What was named in each set: kinds of causes with the number of their scan, and of errors along the scan."""
    problem, reduced, start = posed(corners)
    found = explain(problem, reduced, start, assumed)
    causes = candidates(start.position.shape[-2], reduced.curved, start.n)
    names = []
    for i in range(len(found.gain)):
        chosen = [causes[number] for number in found.causes[:, i].tolist() if number != NONE]
        words = [cause.kind if cause.scan == NONE else f"{cause.kind} {cause.scan}" for cause in chosen]
        rivals = {causes[k].kind for k in found.rivals[:, i].nonzero().flatten().tolist()}
        along = found.along_scan[i]
        if along is not None:
            words.append("encoder" if COMPONENTS[int(along.rms_mm.argmax())] == "travel" else "shake")
        names.append((words, rivals))
    return names


def share(corners, *expected, assumed=PRIOR):
    """Share of the sets in which just the expected causes were named."""
    found = [words for words, _ in named(corners, assumed)]
    return sum(words == list(expected) for words in found) / len(found), Counter(map(tuple, found))


def cases(sets, sigma=SIGMA):
    """Contradictions of the sizes that must be named, and the names."""
    last = len(THREE) - 1
    yield faster(THREE, (1.00, 1.03, 1.06), sets, sigma), "speed"
    yield faster(THREE[:2], (1.0, 1.03), sets, sigma), "speed 1"
    yield faster(THREE, (1.0, 1.0, 1.03), sets, sigma), f"speed {last}"
    yield drifting_last(THREE, (0.005, 0.0, 0.0), sets, sigma), f"sideways {last}"
    for stated in (0.97, 30 / 25, 1.001):
        yield other_size(sound(THREE, sets, sigma), stated), "scale"
    yield bent(sound(THREE, sets, sigma), THREE, 0.5), "bend"


def test_the_cause_is_named():
    torch.manual_seed(0)
    for corners, expected in cases(FAST):
        right, found = share(corners, expected)
        assert right == 1.0, (expected, found)


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "sets"), [(SIGMA, SLOW), (DETECTED, 40)])
def test_the_cause_is_named_in_95_of_100_sets(sigma, sets):
    torch.manual_seed(1)
    for corners, expected in cases(sets, sigma):
        right, found = share(corners, expected)
        assert right >= 0.95, (expected, found)


@pytest.mark.parametrize("sets", [FAST, pytest.param(SLOW, marks=pytest.mark.slow)])
@pytest.mark.parametrize("sigma", [SIGMA, DETECTED])
def test_a_drift_in_depth_is_named_or_stands_beside_the_drift_sideways_that_looks_like_it(sets, sigma):
    """The third board is tilted about the travel axis alone: n1 and n3 look alike on it but for the stretch."""
    torch.manual_seed(2)
    found = named(drifting_last(THREE, (0.0, 0.0, 0.01), sets, sigma))
    right = [words in (["depth 2"], ["sideways 2"]) and "depth" in rivals for words, rivals in found]
    assert sum(right) >= 0.95 * sets, Counter(tuple(words) for words, _ in found)


def sound_sets(sets):
    for tilts in (THREE[:2], THREE):
        for factor in (1.0, 2.0, 0.5):
            yield noisier_than_stated(tilts, sets, factor)
    yield noisier_than_stated(THREE, sets, 1.0, DETECTED)
    yield noisier_than_stated(EIGHT, sets, 1.0)


def test_sound_boards_have_no_cause():
    torch.manual_seed(3)
    for corners in sound_sets(FAST):
        assert share(corners)[0] == 1.0


@pytest.mark.slow
def test_false_alarms_are_rarer_than_two_in_a_hundred():
    torch.manual_seed(4)
    for corners in sound_sets(SLOW):
        right, found = share(corners)
        assert right >= 0.98, found


@pytest.mark.parametrize("sets", [FAST, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "wavelength", [61.0, 233.0, *(pytest.param(long, marks=pytest.mark.slow) for long in (97.0, 480.0))]
)
def test_a_shake_is_called_a_shake_and_no_motion_of_single_scans(wavelength, sets):
    torch.manual_seed(5)
    right, found = share(shaken(sound(THREE, sets), 0.03, wavelength), "shake")
    assert right >= 0.98, found


@pytest.mark.parametrize("wavelength", [60.0, 400.0])
def test_a_wrong_travel_is_called_one(wavelength):
    torch.manual_seed(6)
    right, found = share(shaken(sound(THREE, FAST), 0.1, wavelength, (1,)), "encoder")
    assert right == 1.0, found


def test_two_causes_at_once_are_both_named():
    torch.manual_seed(7)
    both = other_size(faster(THREE, (1.0, 1.0, 1.03), FAST), 0.97)
    assert all(set(words) == {"scale", "speed 2"} for words, _ in named(both))
    assert share(shaken(faster(THREE, (1.0, 1.0, 1.03), FAST), 0.03, 97.0), "speed 2", "shake")[0] == 1.0


def test_a_size_within_its_stated_sigma_is_no_contradiction():
    torch.manual_seed(8)
    larger = other_size(sound(THREE, FAST), 1.0005)
    assert share(larger, "scale")[0] == 1.0
    assert share(larger, assumed=Assumed(0.05, 1e-3))[0] == 1.0


@pytest.mark.slow
def test_departures_come_out_with_their_sigmas():
    torch.manual_seed(9)
    problem, reduced, start = posed(faster(THREE, (1.00, 1.03, 1.06), 200))
    found = explain(problem, reduced, start, Assumed(0.05))
    speed, covariance = found.departure[..., 0], found.covariance[:, 0]
    for scan, truth in ((1, 0.03), (2, 0.06)):
        ratio = (1 + speed[:, scan]) / (1 + speed[:, 0])
        variance = covariance[:, scan, scan] + ratio.square() * covariance[:, 0, 0] - 2 * ratio * covariance[:, 0, scan]
        assert 0.75 < ((ratio - 1 - truth).square() / variance * (1 + speed[:, 0]).square()).mean() < 1.3
    assert found.chi_square.median() < 100 < 1e5 < found.chi_square_before.median()


def test_batch_equals_loop():
    torch.manual_seed(10)
    corners = faster(THREE, (1.00, 1.03, 1.06), 4)
    problem, reduced, start = posed(corners)
    together = explain(problem, reduced, start, Assumed(0.05))
    for i in (1, 3):
        chosen = torch.arange(4) == i
        one = posed(replace(corners, points=corners.points[chosen], covariance=corners.covariance[chosen],
                            board_points=corners.board_points[chosen], valid=corners.valid[chosen]))  # fmt: skip
        alone = explain(*one, Assumed(0.05))
        assert torch.equal(alone.causes[:, 0], together.causes[:, i])
        torch.testing.assert_close(alone.departure[0], together.departure[i], rtol=0, atol=1e-9)


def test_jacobian_is_the_derivative_of_the_residuals():
    torch.manual_seed(11)
    _, reduced, start = posed(simulate(batch=(1,)))
    at = Placement(start.rotation, start.position, start.n, start.departure + 0.01)
    rows = residual_and_jacobian(reduced, at)
    J = rows[..., :-1]
    for column in range(16):
        move = torch.zeros(1, 3, J.shape[-1], dtype=torch.float64)
        move[..., column] = 1e-6
        pose, n, departure = move.split([6, 3, len(KINDS)], dim=-1)
        up = residual_and_jacobian(reduced, at.moved(pose, n[:, 0], departure))[..., -1]
        down = residual_and_jacobian(reduced, at.moved(-pose, -n[:, 0], -departure))[..., -1]
        numeric = (down - up) / 2e-6
        torch.testing.assert_close(numeric, J[..., column], rtol=1e-4, atol=1e-5 * float(J[..., column].abs().max()))


def test_rows_of_the_corners_are_those_of_the_reduced_ones():
    """In sigmas their products agree, but for shifts of the board and what no features explain."""
    torch.manual_seed(12)
    problem, reduced, start = posed(simulate(batch=(1,)))
    at = Placement(start.rotation, start.position, start.n, start.departure + 0.01)
    whitened = torch.linalg.solve_triangular(problem.noise_chol, corner_rows(problem, at), upper=False).flatten(2, 3)
    products = []
    for rows in (whitened, residual_and_jacobian(reduced, at)):
        shifts = torch.linalg.qr(rows[..., 3:6]).Q
        unshifted = rows - shifts @ (shifts.mT @ rows)
        products.append((unshifted.mT @ unshifted)[..., :-1, :])
    torch.testing.assert_close(*products)
