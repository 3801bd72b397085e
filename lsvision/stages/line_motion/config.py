"""Options of the motion from line to line."""

from dataclasses import dataclass

from lsvision.schema import Checked, Interval, IntFrom2, NonNegative, Positive, PositiveInt, Share, Text


@dataclass(frozen=True)
class LineMotionConfig(Checked):
    """How the motion from line to line is measured on the profile of an object that is the same all along, as a rail.

    The reference is the object's own robust mean profile over up to ``reference_lines`` lines, as deep as
    ``profile_depth_mm`` under its crown: what lies deeper need not move with it. Depths outside ``height_range_mm``
    count as not measured. Every line is registered to it in ``iterations`` of Gauss-Newton steps; a sample counts the
    less the further it lies off, and not at all beyond ``cut_sigma`` of its standard deviations: defects are outliers.
    Of the columns at most ``samples`` are used, as neighbours err alike. A line of which less than ``min_share`` of the
    object's samples was measured is interpolated from the others. So is one that lies more than ``largest_mm`` above or
    below most lines: it shows another object, as the conveyor before and behind a sheet.
    ``reference`` is ``scan``; or a nominal section: ``EN60E1``, the head of the rail 60E1, or the path of a CSV with
    the columns across_mm and height_mm. It is laid on the scan's own mean profile and takes its place, without its
    noise, where at least half of that lies within ``section_within_mm`` of the section. What departs from it is added.
    So it is known where the object lies in the product, how it is rolled there, and where it is worn.
    The errors of a line follow from what the registration leaves; ``common_error_px`` of disparity is what a line's
    depths err by all together besides (on rendered rails up to 0.005). ``expected_x_mm``, ``expected_z_mm`` and
    ``expected_roll_deg`` are the usual vibration (rms): they separate components that look alike on the profile, as
    roll and sideways motion of a crown. A component whose error on a line exceeds twice that is not observed.
    ``evidence`` is how much better, in units of the logarithm of the likelihood, the lines must fit with a component
    for it to be corrected; and it must be ``least_ratio`` times the errors of a single line at least, as errors of the
    matching may last for many lines.
    Waves along the travel longer than ``shape_longer_than_mm`` count as the object's shape, as bow and corrugation, and
    stay in the height: a profile alone does not distinguish them from vibration. null takes all for vibration but
    what the lines of the colours separate.
    Lines are smoothed in blocks of ``block_lines`` with ``halo_lines`` on either side.
    """

    reference: Text = "scan"
    section_within_mm: Positive = 0.3
    height_range_mm: Interval = (-60.0, 60.0)
    profile_depth_mm: Positive = 40.0
    reference_lines: IntFrom2 = 512
    samples: PositiveInt = 300
    iterations: IntFrom2 = 4
    cut_sigma: Positive = 4.0
    min_share: Share = 0.3
    largest_mm: Positive = 10.0
    common_error_px: NonNegative = 0.004
    expected_x_mm: Positive = 0.2
    expected_z_mm: Positive = 0.2
    expected_roll_deg: Positive = 0.02
    evidence: NonNegative = 12.0
    least_ratio: NonNegative = 1.0
    shape_longer_than_mm: Positive | None = None
    straight_edges: bool = True
    edge_share: Share = 0.5
    edges_within_mm: Positive = 0.1
    block_lines: PositiveInt = 256
    halo_lines: PositiveInt = 192
