"""Options of the surface."""

from dataclasses import dataclass

from lsvision.schema import Checked, Interval, IntFrom2, NonNegative, Positive, PositiveInt, Text


@dataclass(frozen=True)
class SurfaceConfig(Checked):
    """How the surface of an object that is the same all along is inspected.

    The reference is the robust mean profile of the product, as deep as ``profile_depth_mm`` under its crown, from
    ``profile_rows`` rows of each piece of ``local_mm``. What lies more than ``largest_mm`` off it along the normal is
    another object. Deviations of candidates are taken from the profile of their surroundings, ``local_mm`` long, moved
    and rolled as each row is: so neither a bend of the object nor a motion that was left makes one.

    Deviations are smoothed by a Gaussian of the standard deviation ``smoothing_mm``, two cells at least. A candidate is
    a connected place beyond ``low_sigma`` standard deviations of sound surface that somewhere exceeds ``high_sigma``
    and ``least_depth_mm``, and is ``least_area_mm2`` large. Its depth is that of a paraboloid about its deepest place,
    and makes good what the windows of the matching blur: ``matching_blur`` cells of the product (standard deviation),
    as measured on rendered pits with a ``refine_window`` of 9 px; 0 for depths of the camera's own.

    Places beyond ``color_low_sigma`` and somewhere ``color_high_sigma`` in relative brightness, which at least departs
    by ``least_contrast``, are candidates by their colour alone. Within ``margin_mm``, or twelve cells, of the ends and
    gaps of the profile, where windows of the matching see more than one height, nothing is looked for. The
    ``most_candidates`` that stand out most are kept.

    Marks repeat where at least ``least_marks`` of one kind follow each other at the same place around the object, to
    ``mark_tolerance_mm``, with a period within ``mark_period_mm``.

    ``reference`` is ``scan``; or a nominal section, ``EN60E1`` or the path of a CSV, that wear is measured against.
    """

    reference: Text = "scan"
    profile_depth_mm: Positive = 30.0
    profile_rows: IntFrom2 = 48
    local_mm: Positive = 300.0
    largest_mm: Positive = 5.0
    margin_mm: NonNegative = 2.5
    smoothing_mm: Positive = 0.3
    high_sigma: Positive = 8.0
    low_sigma: Positive = 3.0
    least_depth_mm: NonNegative = 0.03
    least_area_mm2: NonNegative = 2.0
    matching_blur: NonNegative = 4.5
    color_high_sigma: Positive = 8.0
    color_low_sigma: Positive = 4.0
    least_contrast: NonNegative = 0.15
    most_candidates: PositiveInt = 10_000
    least_marks: IntFrom2 = 4
    mark_tolerance_mm: Positive = 3.0
    mark_period_mm: Interval = (50.0, 5000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (("low_sigma", "high_sigma"), ("color_low_sigma", "color_high_sigma")):
            if getattr(self, low) > getattr(self, high):
                raise self.fault(low, f"expected at most {high}, {getattr(self, high):g}, got {getattr(self, low):g}")
