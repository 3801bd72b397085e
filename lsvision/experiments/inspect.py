"""``+experiment=inspect``: a product -> its unrolled surface, and what on it may be a defect."""

import logging
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lsvision.archive.inspection import Inspection, inspect_product
from lsvision.experiments.settings import RunSettings
from lsvision.image.tiling import keep_freed_memory
from lsvision.io import read_product, read_surface, write_json
from lsvision.report.progress import progress_bars
from lsvision.report.surface_pages import surface_report
from lsvision.report.surface_words import candidates_in_words, marks_in_words, surface_words, wear_in_words
from lsvision.schema import Text
from lsvision.stages.surface.config import SurfaceConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class InspectSettings(RunSettings):
    """Options of the experiment: a product of ``correct`` or ``reprocess``, and how its surface is inspected.

    The unrolled images and the tables of candidates become a part of the product, ``surface``.
    """

    product: Text
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)


def run_inspect(settings: InspectSettings, folder: Path) -> None:
    """Inspect the product; write its ``surface``, ``summary.json`` and the report."""
    keep_freed_memory()
    product = read_product(settings.product)
    with progress_bars() as bars:
        bar = bars.start(f"inspect {product.path.stem}", total=product.grid.rows)
        inspection = inspect_product(product, settings.surface, lambda rows: bars.advance(bar, rows))
    write_json(folder / "summary.json", summary_of(inspection))
    for line in surface_words(inspection.metadata):
        log.info("%s", line)
    if settings.surface.reference != "scan":
        log.info("%s", wear_in_words(inspection.wear, settings.surface.reference))
    log.info("%s", candidates_in_words(inspection.marked.candidates))
    for group in inspection.marked.groups:
        log.info("%s", marks_in_words(group))
    log.info("wrote %s", inspection.path)
    surface_report(product, read_surface(product), inspection, asdict(settings), folder)


def summary_of(inspection: Inspection) -> dict[str, Any]:
    """What was found, as plain data."""
    counts = Counter(candidate.kind for candidate in inspection.marked.candidates)
    return {
        "surface": str(inspection.path),
        **inspection.metadata,
        "candidates": dict(counts),
        "marks": [asdict(group) for group in inspection.marked.groups],
        "wear": [asdict(piece) for piece in inspection.wear],
    }
