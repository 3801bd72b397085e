"""Errors along the scans of a batch of problems: whether residuals look like them, and the noise that they make."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation.gaussian_process import covariance_root
from lsvision.stages.calibration.along_scan.check import SUSPICION, can_be
from lsvision.stages.calibration.along_scan.edges import EdgeRows
from lsvision.stages.calibration.along_scan.evidence import Linearised
from lsvision.stages.calibration.along_scan.kernels import FINE, SEARCHED, Knots, kernel_family, wave_length
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Travel, latents
from lsvision.stages.calibration.along_scan.search import Beforehand, FoundErrors, search
from lsvision.stages.calibration.along_scan.spectrum import Spectrum
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.reduction import CorrelatedNoise, affine_features, rows_with_latents

# Probability of residuals below which they are no noise, though no errors along the scan were found.
_BEYOND_DOUBT = 1e-4


@dataclass(frozen=True)
class ErrorsAlongScan:
    """The errors along the scans of a batch of problems, zero where none were ``found``.

    Those that are ``unlike`` any process that was tried have sigmas that need not cover what they do to n. ``rms_mm``
    and ``length_mm`` are those of each component: the length of a wave as correlated. ``spectrum`` is what it is made
    of, ``log_ratio`` how much more probable the corners are with it than without. ``factor_of_n`` is that of the
    covariance that n owes to the spectrum. ``noise`` is the corners' noise with these errors, None where none were
    found in any problem, as given where they were in others.
    """

    found: Bool[Tensor, "*batch"]
    unlike: Bool[Tensor, "*batch"]
    rms_mm: Float[Tensor, "*batch 4"]
    length_mm: Float[Tensor, "*batch 4"]
    spectrum: Spectrum
    log_ratio: Float[Tensor, "*batch 4"]
    factor_of_n: Float[Tensor, "*batch 3 3"]
    noise: CorrelatedNoise | None

    def problem(self, problem: BoardProblem) -> BoardProblem:
        """Those of the problems in which errors were found, in a row, with their noise."""
        return replace(problem, correlated=self.noise).at(self.found)


def errors_along_scan(
    problem: BoardProblem,
    state: Float[Tensor, "*batch state"],
    probability: Float[Tensor, "*batch"],
    prior_sigma: float,
    known: Beforehand,
) -> ErrorsAlongScan:
    """The errors along the scan for which residuals give evidence.

    Problems are looked at one by one, so that no bit of one depends on the others, and the doubtful ones alone, as each
    takes a tenth of a second.

    Args:
        state: of the problems with white noise.
        probability: of residuals as much correlated, see ``by_chance``.
        prior_sigma: of each component of n.
    """
    rms, length, log_ratio = (state.new_zeros(*state.shape[:-1], len(COMPONENTS)) for _ in range(3))
    spectrum = _no_spectrum(rms)
    factor_of_n = state.new_zeros(*state.shape[:-1], 3, 3)
    doubtful = probability < SUSPICION
    found, unlike = doubtful.clone(), torch.zeros_like(doubtful)
    if not bool(found.any()):
        return ErrorsAlongScan(found, unlike, rms, length, spectrum, log_ratio, factor_of_n, None)
    rows, log_det = problem.affine_rows.clone(), problem.noise_log_det.clone()
    for index in doubtful.nonzero():
        place = tuple(index.tolist())
        one = problem.at(place)
        linearised = Linearised.of(one, state[place], prior_sigma)
        errors = search(one, linearised, known)
        if errors is None:
            found[place] = False
            unlike[place] = (probability[place] < _BEYOND_DOUBT) & (known.process_sigma == 0)
            continue
        rms[place], log_ratio[place] = errors.rms_mm, errors.log_ratio
        factor_of_n[place] = errors.factor_of_shared
        spectrum.set(place, errors.spectrum)
        travel = Travel.of(one)
        length[place] = wave_length(errors.covariance(SEARCHED)) * travel.extent_mm
        searched, fine = (covariance_root(_covariance(errors, travel, known, knots)) for knots in (SEARCHED, FINE))
        unlike[place] = not can_be(one, linearised, searched)
        noise = with_processes(one, fine)
        rows[place], log_det[place] = noise.rows, noise.log_det
    with_errors = CorrelatedNoise(rows, log_det) if bool(found.any()) else None
    return ErrorsAlongScan(found, unlike, rms, length, spectrum, log_ratio, factor_of_n, with_errors)


def _no_spectrum(rms: Float[Tensor, "*batch 4"]) -> Spectrum:
    """That of a batch of problems without errors along the scan."""
    variances = rms.new_zeros(*rms.shape, len(kernel_family(FINE).log_prior))
    return Spectrum.of_kernels(variances).padded()


def _covariance(errors: FoundErrors, travel: Travel, known: Beforehand, knots: Knots) -> Tensor:
    """Covariance, ``(_, 4, knots, knots)`` mm², of what errors and, by board, a walk of n displace the lines by."""
    covariance = errors.covariance(knots)[None]
    return covariance + travel.walk(known.process_sigma, knots) if known.process_sigma else covariance


def with_processes(
    problem: BoardProblem,
    roots: Float[Tensor, "_ 4 knots columns"],
    knots: Knots = FINE,
    edges: EdgeRows | None = None,
) -> CorrelatedNoise:
    """The noise of a problem's corners and of a process per board and component, given by its root at the knots, mm.

    Edges of the boards are measured besides.

    Args:
        problem: of batch shape ().
    """
    features = affine_features(problem.body_points)
    by_latents = latents(problem, roots, knots)
    further = None if edges is None else edges.on_latents(roots, knots)
    noise = rows_with_latents(problem.noise_chol, problem.points, features, problem.valid, by_latents, further)
    return replace(noise, log_det=problem.noise_log_det + noise.log_det, further=0.0 if edges is None else edges.values)
