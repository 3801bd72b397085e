"""What was found on a surface, in words."""

from collections.abc import Mapping, Sequence
from typing import Any

from lsvision.types import Candidate, MarkGroup


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
