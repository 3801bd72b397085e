"""The report of a surface."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lsvision.archive import InspectedScan
from lsvision.archive.inspection import Inspection
from lsvision.io import Product, Surface
from lsvision.report.pages import Headline, Page, Table, write_report
from lsvision.report.surface_figures import gallery, profile_and_scatter, unrolled_map
from lsvision.report.surface_words import candidates_in_words, marks_in_words, surface_words, wear_in_words
from lsvision.types import Candidate, MarkGroup, SectionWear

if TYPE_CHECKING:
    import polars

WORST = 50  # candidates of an archive that its report lists
_SHOWN, _LISTED = 24, 100  # candidates in the gallery and in the table


def surface_report(product: Product, surface: Surface, inspection: Inspection, settings: dict, folder: Path) -> None:
    """``report.html``: the unrolled map, the candidates as a table and a gallery, and marks that repeat."""
    candidates, groups = inspection.marked.candidates, inspection.marked.groups
    metadata, sigma = inspection.metadata, inspection.metadata["sound_sigma_mm"]
    metres = metadata["length_mm"] / 1e3
    shown = candidates[:_SHOWN]
    name = metadata["options"]["reference"]
    worn = [] if name == "scan" else [wear_in_words(inspection.wear, name)]
    page = Page(
        title=f"Surface of {product.path.stem}",
        lead=". ".join([*surface_words(metadata), *(marks_in_words(group) for group in groups), *worn]),
        headlines=[
            Headline("Candidates", str(len(candidates)), candidates_in_words(candidates)),
            Headline("A metre", f"{len(candidates) / metres:.1f}", f"of {metres:.2f} m"),
            Headline("Marks that repeat", str(len(groups)), "groups"),
            Headline("Scatter", f"{1e3 * sigma['smoothed']:.2g} um", "of sound surface, smoothed"),
        ],
        tables=[
            *([_groups_table(groups)] if groups else []),
            *([_candidates_table(candidates)] if candidates else []),
            *([_wear_table(inspection.wear)] if inspection.wear else []),
        ],
        figures=[
            unrolled_map(surface, candidates, sigma["smoothed"]),
            *([gallery(surface, shown)] if shown else []),
            profile_and_scatter(inspection.plan),
        ],
        settings=settings,
        provenance={"product": str(product.path)},
    )
    write_report(page, folder)


def _candidates_table(candidates: Sequence[Candidate]) -> Table:
    header = (
        "no.", "kind", "along [mm]", "around [mm]", "side", "depth [um]", "size [mm]", "volume [mm³]", "contrast",
        "over sigma", "group",
    )  # fmt: skip
    note = (
        f"Those that stand out most, {min(len(candidates), _LISTED)} of {len(candidates)}; all of them, each quantity "
        "with its standard deviation, are in defects.parquet, defects.csv and defects.geojson of the product's folder "
        "surface. Depth is that of the deepest place, above zero outwards; the size is that of the ellipse "
        "with the same second moments."
    )
    return Table("Candidates", header, [_row(number, one) for number, one in enumerate(candidates[:_LISTED], 1)], note)


def _row(number: int, candidate: Candidate) -> tuple[str, ...]:
    relief = candidate.kind != "color"
    return (
        str(number),
        candidate.kind,
        f"{candidate.along_mm:.2f}",
        f"{candidate.around_mm:+.2f}",
        candidate.side,
        f"{1e3 * candidate.depth_mm:+.0f} ± {1e3 * candidate.depth_sigma_mm:.0f}" if relief else "",
        f"{candidate.length_mm:.1f} x {candidate.width_mm:.1f}",
        f"{candidate.volume_mm3:+.2f}" if relief else "",
        f"{100 * candidate.contrast:+.0f} %",
        f"{candidate.ratio:.0f}",
        "" if candidate.group is None else str(candidate.group),
    )


def _groups_table(groups: Sequence[MarkGroup]) -> Table:
    header = ("group", "kind", "marks", "turns", "period [mm]", "roll's diameter [mm]", "around [mm]", "depth [um]")
    rows = [
        (
            str(group.number), group.kind, str(group.marks), str(group.turns),
            f"{group.period_mm:.2f} ± {group.period_sigma_mm:.2g}", f"{group.period_mm / math.pi:.2f}",
            f"{group.around_mm:+.1f}", f"{1e3 * group.depth_mm:+.0f}",
        )
        for group in groups
    ]  # fmt: skip
    return Table("Marks that repeat", header, rows, "A damaged roll leaves a mark at each turn.")


def _wear_table(pieces: Sequence[SectionWear]) -> Table:
    header = (
        "along [mm]",
        "on the section",
        "crown [um]",
        "left corner [um]",
        "right corner [um]",
        "head's width [mm]",
    )
    rows = [
        (
            f"{piece.first_mm:.0f} .. {piece.last_mm:.0f}",
            f"{100 * piece.share:.0f} %",
            _loss(piece.crown_mm, piece.crown_sigma_mm),
            _loss(piece.left_corner_mm, piece.corner_sigma_mm),
            _loss(piece.right_corner_mm, piece.corner_sigma_mm),
            "not seen" if piece.width_mm is None else f"{piece.width_mm:.3f} ± {piece.width_sigma_mm:.2g}",
        )
        for piece in pieces
    ]
    note = (
        "Distance from the nominal section along its normal, below zero where metal is gone: mean over the middle of "
        "the head, and the worst 2 mm of each gauge corner. The section is laid on what is not worn."
    )
    return Table("Wear", header, rows, note)


def _loss(value_mm: float | None, sigma_mm: float) -> str:
    return "not seen" if value_mm is None else f"{1e3 * value_mm:+.0f} ± {1e3 * sigma_mm:.2g}"


def surfaces_tables(surfaces: Sequence[InspectedScan], worst: "polars.DataFrame") -> list[Table]:
    """Candidates by scan of an archive, most a metre first, and those that stand out most of all."""
    by_rate = sorted(surfaces, key=lambda surface: -surface.per_metre)
    rows = [
        (
            surface.scan, f"{surface.length_mm / 1e3:.2f}", str(surface.dents), str(surface.bumps), str(surface.colors),
            f"{surface.per_metre:.1f}", f"{surface.worst:.0f}" if surface.worst else "", surface.problem,
        )
        for surface in by_rate
    ]  # fmt: skip
    header = (
        "scan", "length [m]", "dents", "bumps", "by colour", "dents and bumps a metre", "largest over sigma", "problem",
    )  # fmt: skip
    first = Table("Surfaces", header, rows)
    if not len(worst):
        return [first]
    listed = [
        (
            row["scan"], row["kind"], f"{row['along_mm']:.1f}", f"{row['around_mm']:+.1f}", row["side"],
            "" if row["depth_mm"] is None else f"{1e3 * row['depth_mm']:+.0f}",
            f"{row['length_mm']:.1f} x {row['width_mm']:.1f}", f"{row['ratio']:.0f}",
        )
        for row in worst.iter_rows(named=True)
    ]  # fmt: skip
    header = ("scan", "kind", "along [mm]", "around [mm]", "side", "depth [um]", "size [mm]", "over sigma")
    note = "All candidates are in defects.parquet of the output, those that stand out most first."
    return [first, Table("Worst candidates", header, listed, note)]
