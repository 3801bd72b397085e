"""Nine-state filters on board corners: a batch, compared with filterpy's CubatureKalmanFilter in a Python loop.

Both predict a random walk and update with 50 measurements of three values, on one thread. filterpy's points are
redrawn after the prediction, which its own update omits. Its time per filter and step does not depend on the number of
filters in the loop, so a dozen of them are timed.
"""

import math
import time

import numpy as np
import torch
from filterpy.kalman import CubatureKalmanFilter
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from torch import Tensor

from lsvision.estimation import Gaussian, StateSpace, filter_sequence

STEPS = 50
BATCHES = (1, 100, 1000, 10000)
TURNS = 12
MEAN = [0.01, 0.02, 0.01, 10.0, 20.0, 800.0, 0.0, 1.0, 0.0]
PRIOR_SIGMA = [0.01] * 3 + [1.0] * 3 + [0.01] * 3
NOISE_SIGMA, PROCESS_SIGMA = 0.02, 1e-5
CORNERS = [(30.0 * (step % 11) - 150.0, 30.0 * (step // 11) - 75.0) for step in range(STEPS)]


def corner(states: Tensor, step: int) -> Tensor:
    """Measured (x, y, z) of the step's corner R(theta) p + t, which the motion n carries to the scan plane."""
    a, b, c, t1, t2, t3, n1, n2, n3 = states.unbind(-1)
    px, py = CORNERS[step]
    half = torch.addcmul(a * a, b, b).addcmul_(c, c).sqrt_().div_(2)
    sine = torch.sin(half)
    sinc, squared = sine / half, sine.square()
    first, second, cosine = (1 - squared).sqrt_().mul_(sinc), sinc.square_().div_(2), squared.mul_(-2).add_(1)
    along, turned = (a * px).add_(b, alpha=py).mul_(second), c * first
    x = torch.addcmul(t1, a, along).add_(cosine, alpha=px).sub_(turned, alpha=py)
    y = torch.addcmul(t2, b, along).add_(cosine, alpha=py).add_(turned, alpha=px)
    z = torch.addcmul(t3, c, along).addcmul_((a * py).sub_(b, alpha=px), first)
    travel = y.div_(n2)
    values = torch.stack([x.addcmul_(travel, n1, value=-1), travel, z.addcmul_(travel, n3, value=-1)])
    return values.movedim(0, -1)  # component by component in memory, as the filter works


def corner_of_one(state: np.ndarray, step: int) -> np.ndarray:
    """``corner`` of one state, in plain floats, which filterpy takes faster than small arrays."""
    a, b, c, t1, t2, t3, n1, n2, n3 = state.tolist()
    px, py = CORNERS[step]
    half = math.sqrt(a * a + b * b + c * c) / 2
    sine = math.sin(half)
    sinc, squared = sine / half, sine * sine
    first, second, cosine = math.sqrt(1 - squared) * sinc, sinc * sinc / 2, 1 - 2 * squared
    along = second * (a * px + b * py)
    x = t1 + a * along + cosine * px - c * first * py
    y = t2 + b * along + cosine * py + c * first * px
    z = t3 + c * along + first * (a * py - b * px)
    travel = y / n2
    return np.array([x - travel * n1, travel, z - travel * n3])


def run() -> dict[str, object]:
    """Microseconds per filter and step of both, by batch; ``ratio`` is that of 1000 filters.

    The two take turns, and the best turn of each counts: a machine that slows down for a while slows both.
    """
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    truth = torch.tensor(MEAN, dtype=torch.float64)
    exact = torch.stack([corner(truth, step) for step in range(STEPS)])
    ours, peer, difference = {}, {}, 0.0
    for batch in BATCHES:
        noise = torch.randn(STEPS, batch, 3, dtype=torch.float64, generator=generator)
        measured = exact[:, None] + NOISE_SIGMA * noise
        ours[batch] = peer[batch] = math.inf
        for turn in range(TURNS):
            seconds, means = _run_ours(measured[:, 0] if batch == 1 else measured)
            index = turn % batch
            peer_seconds, peer_mean = _run_peer(measured[:, index].numpy())
            ours[batch] = min(ours[batch], seconds / (STEPS * batch) * 1e6)
            peer[batch] = min(peer[batch], peer_seconds / STEPS * 1e6)
            error = np.abs(means.reshape(-1, 9)[index].numpy() - peer_mean) / PRIOR_SIGMA
            difference = max(difference, float(error.max()))
    return {
        "unit": "microseconds per filter and step",
        "lsvision": {str(batch): round(value, 3) for batch, value in ours.items()},
        "filterpy": {str(batch): round(value, 1) for batch, value in peer.items()},
        "ratios": {str(batch): round(peer[batch] / ours[batch], 2) for batch in BATCHES},
        "ratio": round(peer[1000] / ours[1000], 1),
        "largest_difference_in_prior_sigmas": difference,
    }


def _run_ours(measured: Tensor) -> tuple[float, Tensor]:
    batch = measured.shape[1:-1]
    mean = torch.tensor(MEAN, dtype=torch.float64).expand(*batch, 9)
    chol = torch.diag(torch.tensor(PRIOR_SIGMA, dtype=torch.float64)).expand(*batch, 9, 9)
    model = StateSpace(corner, NOISE_SIGMA * torch.eye(3).double(), PROCESS_SIGMA * torch.eye(9).double())
    begin = time.perf_counter()
    with torch.inference_mode():
        track = filter_sequence(model, Gaussian(mean, chol), measured, history=False)
    return time.perf_counter() - begin, track.means[-1]


def _run_peer(measured: np.ndarray) -> tuple[float, np.ndarray]:
    peer = CubatureKalmanFilter(9, 3, 1.0, corner_of_one, lambda state, _: state)
    peer.x, peer.P = np.array(MEAN), np.diag(PRIOR_SIGMA) ** 2
    peer.Q, peer.R = np.eye(9) * PROCESS_SIGMA**2, np.eye(3) * NOISE_SIGMA**2
    begin = time.perf_counter()
    for step, value in enumerate(measured):
        peer.predict()
        peer.sigmas_f = spherical_radial_sigmas(peer.x, peer.P)
        peer.update(value[:, None], hx_args=(step,))
    return time.perf_counter() - begin, peer.x.ravel()
