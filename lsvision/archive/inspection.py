"""One product -> its surface: unrolled images and tables of candidates, written into it."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lsvision.errors import LsvisionError
from lsvision.image.tiling import one_torch_thread
from lsvision.io import Product, read_section, surface_writer, write_candidates, write_wear
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.inspect import SurfacePlan, find_candidates
from lsvision.stages.surface.marks import MarkedSurface
from lsvision.stages.surface.profile import NoProfileError
from lsvision.stages.surface.strips import STRIP_ROWS, SurfaceStrip
from lsvision.stages.surface.wear import worn
from lsvision.types import SectionWear


@dataclass(frozen=True)
class Inspection:
    """The surface of a product, and what was found on it; ``metadata`` is what the surface says about itself."""

    path: Path
    metadata: dict[str, Any]
    marked: MarkedSurface
    plan: SurfacePlan
    wear: list[SectionWear]


def inspect_product(
    product: Product, config: SurfaceConfig, advance: Callable[[int], None] = lambda rows: None
) -> Inspection:
    """Inspect a product, on one thread: the bits are the same wherever it runs.

    Args:
        advance: takes the number of rows that were done.

    Raises:
        LsvisionError: it shows no profile.
        FileFormatError: it is damaged, or the section cannot be read.
    """
    section = None if config.reference == "scan" else read_section(config.reference)
    with one_torch_thread():
        try:
            plan = SurfacePlan.of(product, config)
        except NoProfileError as error:
            raise LsvisionError(f"{product.path}: {error}") from None
        metadata = _metadata(product, plan, config)
        with surface_writer(product, plan.unrolling.grid(product.grid), STRIP_ROWS, metadata) as rows:

            def written(strip: SurfaceStrip) -> None:
                assert strip.sigma is not None  # filled in where the product has none
                rows.write(strip.row, strip.color, strip.deviation, strip.sigma)
                advance(len(strip.deviation))

            marked = find_candidates(product, plan, config, written)
            write_candidates(marked.candidates, rows.folder)
            wear = []
            if section is not None:
                scatter = float(plan.sound.smooth_mm.median())
                wear = worn(plan.profile, section, product.grid, scatter, LineMotionConfig())
                write_wear(wear, rows.folder)
    return Inspection(product.path / "surface", metadata, marked, plan, wear)


def _metadata(product: Product, plan: SurfacePlan, config: SurfaceConfig) -> dict[str, Any]:
    """What a surface says about itself."""
    around = plan.unrolling.around
    return {
        "length_mm": product.grid.rows * product.grid.pitch_mm,
        "around_mm": [float(around[0]), float(around[-1])],
        "crown_mm": {
            "across": float(plan.profile.q_x[plan.profile.height.argmax()]),
            "height": float(plan.profile.height.max()),
        },
        "sound_sigma_mm": {
            "cell": float(plan.sound.cell_mm.median()),
            "smoothed": float(plan.sound.smooth_mm.median()),
            "depth_of_a_candidate": float(plan.sound.fitted_mm.min()),
        },
        "line_motion": str(product.line_motion_metadata.get("source", "none")),
        "options": asdict(config),
    }
