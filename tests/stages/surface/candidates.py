"""Candidates for tests."""

from lsvision.types import Candidate, CandidateKind


def candidate(along_mm: float, around_mm: float, kind: CandidateKind = "dent") -> Candidate:
    """One at a place."""
    return Candidate(
        kind=kind, along_mm=along_mm, along_sigma_mm=0.05, around_mm=around_mm, around_sigma_mm=0.05,
        across_mm=around_mm, slope_deg=0.0, side="top", depth_mm=-0.2, depth_sigma_mm=0.01, length_mm=4.0,
        length_sigma_mm=0.1, width_mm=4.0, width_sigma_mm=0.1, angle_deg=0.0, angle_sigma_deg=50.0, area_mm2=12.0,
        area_sigma_mm2=0.5, volume_mm3=-1.0, volume_sigma_mm3=0.1, contrast=-0.2, contrast_sigma=0.05, ratio=20.0,
        first_row=0, last_row=20, first_column=0, last_column=20,
    )  # fmt: skip
