"""Corners in both raw images of board scans -> a calibrated rig: its quantities, what is known of them, what to do."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lsvision.errors import CalibrationError
from lsvision.geometry import (
    RawPair,
    ideal_rig,
    rotation_from_vector,
    sharp_depth_mm,
    with_covariance,
    with_quantities,
)
from lsvision.stages.rig.advice import next_scan
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.data_sheet import contradicted
from lsvision.stages.rig.height_shape import HeightShape
from lsvision.stages.rig.held_out import FEWEST_BOARDS, HeldOut
from lsvision.stages.rig.model import QUANTITIES, RigPrior
from lsvision.stages.rig.observability import unobserved
from lsvision.stages.rig.shaken import ShakenSolution, allow_for_line_motion
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.stages.rig.solve import RigSolution, solve_rig
from lsvision.types import (
    RIG_QUANTITIES,
    CameraResiduals,
    Motion,
    Pose,
    RawRig,
    RigBoard,
    RigCalibration,
    RigCombination,
    RigVerdict,
)

_LARGEST_NOISE = 3.0  # times the corners' stated sigmas: more is no noise


def calibrate_rig(sightings: Sightings, scans: Sequence[str], rig: RawRig, config: RigConfig) -> RigCalibration:
    """Calibrate a raw rig on boards.

    Args:
        scans: names of the scans, one per board. rig: that of the data sheet, the prior.

    Raises:
        CalibrationError: the corners do not determine the boards' poses.
    """
    prior = RigPrior.of(rig, config)
    still = _finite(solve_rig(sightings, prior, config), scans)
    held_out = HeldOut.of(still, config) if config.held_out and still.sightings.boards >= FEWEST_BOARDS else None
    contradicting = _contradicting(still, scans, held_out)
    # One scan that contradicts all others is no vibration: line motion would hide which it is.
    shaken = ShakenSolution(still, ()) if contradicting else allow_for_line_motion(still, sightings, config)
    solution, held_out = _finite(shaken.solution, scans), None if shaken.errors else held_out
    shared = solution.shared
    depth_range_mm = config.depth_range_mm or sharp_depth_mm(ideal_rig(rig))
    shape = HeightShape.of(rig, shared, prior.sigma, depth_range_mm)
    weak = unobserved(solution, shape, config)
    advice = next_scan(solution, shape, depth_range_mm).in_words
    wrong_sheet = None if shaken.errors or contradicting else contradicted(solution, config)
    reasons = [*_faults(solution), *contradicting, *([wrong_sheet] if wrong_sheet else [])]
    bending = [combination for combination in weak if combination.bend_um >= config.least_height_um]
    if bending and not reasons:
        reasons = [*_left_to_the_data_sheet(bending), advice]
    found = with_quantities(rig, shared.quantities)
    covariance = _about_own_depth(solution.covariance, rig, found)
    return RigCalibration(
        rig=with_covariance(found, covariance[:QUANTITIES, :QUANTITIES]),
        motion=Motion(shared.n, covariance[QUANTITIES:, QUANTITIES:]),
        covariance=covariance,
        boards=_boards(solution, scans, held_out),
        residuals=_residuals(solution),
        noise_scale=float(solution.noise_scale),
        height_error_um=1e3 * float(shape.stated_mm(solution.factor)),
        unobserved=weak,
        advice=advice,
        verdict=_verdict(solution, bool(bending), wrong_sheet is not None),
        reasons=tuple(reasons),
        errors_along_scan=shaken.errors,
    )


def _finite(solution: RigSolution, scans: Sequence[str]) -> RigSolution:
    """The solution, where it is one.

    Raises:
        CalibrationError: it is not.
    """
    if not bool(solution.shared.vector.isfinite().all() & solution.found.factor.isfinite().all()):
        raise CalibrationError(f"{', '.join(scans)}: the corners do not determine the boards' poses")
    return solution


def _about_own_depth(covariance: Tensor, start: RawRig, found: RawRig) -> Tensor:
    """Covariance of a rig whose plane counts depth from its own z0, from that of one that does from the start's."""
    moved = RawPair.of(found).z0_mm - RawPair.of(start).z0_mm
    change = torch.eye(len(covariance), dtype=covariance.dtype)
    offset, slope = (RIG_QUANTITIES.index(f"right.view_plane.{name}") for name in ("offset_mm", "slope_z"))
    change[offset, slope] = moved
    both = change @ covariance @ change.mT
    return (both + both.mT) / 2


def _verdict(solution: RigSolution, bending: bool, wrong_sheet: bool) -> RigVerdict:
    if not bool(solution.found.converged):
        return "not converged"
    if float(solution.noise_scale) > _LARGEST_NOISE or wrong_sheet:
        return "inconsistent"
    return "prior-dominated" if bending else "determined"


def _faults(solution: RigSolution) -> list[str]:
    """Why no rig came out, in sentences."""
    faults = []
    if not bool(solution.found.converged):
        faults.append(f"the estimate had not settled after {int(solution.found.iterations)} iterations")
    if float(solution.noise_scale) > _LARGEST_NOISE:
        faults.append(
            f"the corners are off by {float(solution.noise_scale):.1f} times their stated sigmas: the object shook, "
            "its speed changed from scan to scan, or the board or the rig's file is not as stated"
        )
    return faults


def _contradicting(solution: RigSolution, scans: Sequence[str], held_out: HeldOut | None) -> list[str]:
    """The scan without which the others agree, where one contradicts them."""
    if held_out is None or float(solution.noise_scale) <= _LARGEST_NOISE:
        return []
    least = int(held_out.rms_of_others.argmin())
    if float(held_out.rms_of_others[least]) > _LARGEST_NOISE:
        return []
    return [f"without {scans[least]} the others agree to {float(held_out.rms_of_others[least]):.1f} sigmas"]


def _left_to_the_data_sheet(bending: Sequence[RigCombination]) -> list[str]:
    named = "; ".join(f"{item.in_words} (bends heights by {item.bend_um:.2g} um)" for item in bending)
    return [f"the data sheet says more than the scans of {named}"]


def _boards(solution: RigSolution, scans: Sequence[str], held_out: HeldOut | None) -> tuple[RigBoard, ...]:
    model, valid = solution.model, solution.sightings.valid
    own, n = solution.found.state.own, solution.shared.n
    rotation = rotation_from_vector(own[:, :3]) @ model.start.rotation
    middle = model.start.translation + own[:, 3:] + model.middle_mm[:, None] * n
    offset = solution.sightings.board_points[0] - model.body_points[:, 0]  # middle of what was seen, from the origin
    origin = middle - (rotation @ offset[..., None])[..., 0]
    rms = (solution.whitened.square().sum((-2, -1)) / (4 * valid.sum(-1)).clamp(min=1)).sqrt()
    return tuple(
        RigBoard(
            scan=name,
            corners=int(valid[i].sum()),
            outliers=int(solution.outliers[i]),
            pose=Pose(rotation[i], origin[i]),
            rms=float(rms[i]),
            held_out_rms=None if held_out is None else float(held_out.rms[i]),
        )
        for i, name in enumerate(scans)
    )


def _residuals(solution: RigSolution) -> tuple[CameraResiduals, CameraResiduals]:
    """What is left of the corners in the left and in the right image."""
    sightings, predicted = solution.sightings, solution.model.predict(solution.found.state)
    depth = solution.pair.meet(predicted.left[..., 0], predicted.right[..., 0], solution.shared.n).z
    left, right = (
        _residuals_of(eye, there, depth, sightings.valid)
        for eye, there in ((sightings.left, predicted.left), (sightings.right, predicted.right))
    )
    return left, right


def _residuals_of(
    eye: CameraSighting, predicted: torch.Tensor, depth: torch.Tensor, valid: torch.Tensor
) -> CameraResiduals:
    off = torch.where(valid[..., None], eye.position - predicted, torch.nan)
    return CameraResiduals(predicted[..., 0], depth, off)
