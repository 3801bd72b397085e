"""What was found on a surface, in words."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from lsvision.archive import InspectedScan
from lsvision.types import Candidate, MarkGroup, SectionWear


def surface_words(metadata: Mapping[str, Any]) -> list[str]:
    """What was inspected, and how well depth is known on it; then whether motion may be in it."""
    first, last = metadata["around_mm"]
    sigma = metadata["sound_sigma_mm"]
    lines = [
        f"surface of {metadata['length_mm']:.0f} mm by {last - first:.1f} mm around the profile; sound surface "
        f"scatters by {1e3 * sigma['cell']:.2g} um a cell, {1e3 * sigma['smoothed']:.2g} um smoothed"
    ]
    if metadata["line_motion"] == "none":
        lines.append(
            "the product was not corrected for motion from line to line: its deviation holds vibration too; candidates "
            "are taken from each row's own place"
        )
    return lines


def candidates_in_words(candidates: Sequence[Candidate]) -> str:
    """How many of each kind."""
    names = {"dent": ("dent", "dents"), "bump": ("bump", "bumps"), "color": ("mark of colour", "marks of colour alone")}
    parts = []
    for kind, (one, many) in names.items():
        count = sum(candidate.kind == kind for candidate in candidates)
        if count:
            parts.append(f"{count} {one if count == 1 else many}")
    return ", ".join(parts) or "no candidate"


def marks_in_words(group: MarkGroup) -> str:
    """A group of marks that repeat."""
    return (
        f"{group.marks} {group.kind}s of {group.turns} turns repeat every {group.period_mm:.2f} ± "
        f"{group.period_sigma_mm:.2g} mm, {group.around_mm:+.1f} mm around from the crown"
    )


def wear_in_words(pieces: Sequence[SectionWear], name: str) -> str:
    """How an object departs from its nominal section, in the middle of its pieces."""
    there = [piece for piece in pieces if piece.is_section]
    if not there:
        share = max((piece.share for piece in pieces), default=0.0)
        return f"section {name}: at most {100 * share:.0f} % of the profile lie on it, it is another section"
    parts = []
    for key, what in (("crown_mm", "crown"), ("left_corner_mm", "left corner"), ("right_corner_mm", "right corner")):
        values = [value for piece in there if (value := getattr(piece, key)) is not None]
        parts.append(f"{what} {statistics.median(values):+.3f} mm" if values else f"{what} not seen")
    widths = [piece.width_mm for piece in there if piece.width_mm is not None]
    parts.append(f"head {statistics.median(widths):.2f} mm wide 14 mm under the crown" if widths else "width not seen")
    few = "" if len(there) == len(pieces) else f" ({len(pieces) - len(there)} of {len(pieces)} pieces do not fit it)"
    return f"section {name}: {', '.join(parts)}; below zero where metal is gone{few}"


def surfaces_in_words(surfaces: Sequence[InspectedScan]) -> str:
    """The surfaces of an archive."""
    inspected = [surface for surface in surfaces if not surface.problem]
    metres = sum(surface.length_mm for surface in inspected) / 1e3
    relief = sum(surface.dents + surface.bumps for surface in inspected)
    colors = sum(surface.colors for surface in inspected)
    rest = "" if len(inspected) == len(surfaces) else f"; {len(surfaces) - len(inspected)} show no profile"
    return (
        f"surfaces of {len(inspected)} scans, {metres:.1f} m: {relief} dents and bumps, {colors} marks of colour alone"
        f"{rest}"
    )
