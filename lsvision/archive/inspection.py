"""One product -> its surface: unrolled images and tables of candidates, written into it."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lsvision.archive.identity import key_of
from lsvision.image.tiling import one_torch_thread
from lsvision.io import (
    Product,
    read_product,
    read_section,
    surface_metadata,
    surface_writer,
    write_candidates,
    write_no_surface,
    write_wear,
)
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.surface.config import SurfaceConfig
from lsvision.stages.surface.inspect import SurfacePlan, find_candidates
from lsvision.stages.surface.marks import MarkedSurface
from lsvision.stages.surface.profile import NoProfileError
from lsvision.stages.surface.strips import STRIP_ROWS, SurfaceStrip
from lsvision.stages.surface.wear import worn
from lsvision.types import Section, SectionWear


@dataclass(frozen=True)
class Inspection:
    """The surface of a product, and what was found on it; ``metadata`` is what the surface says about itself."""

    path: Path
    metadata: dict[str, Any]
    marked: MarkedSurface
    plan: SurfacePlan
    wear: list[SectionWear]


@dataclass(frozen=True)
class InspectedProduct:
    """How many rows of a product were inspected."""

    lines: int


@dataclass(frozen=True)
class InspectProduct:
    """Inspects the product at a path; ``key`` is the hash of everything that its surface depends on.

    A product without a profile is no error: its surface says so.
    """

    product: str
    config: SurfaceConfig
    key: str

    def run(self) -> InspectedProduct:
        """Inspect, unless a worker that crashed before its outcome was known has."""
        product = read_product(self.product)
        if not is_inspected(self.product, self.key):
            try:
                inspect_product(product, self.config, key=self.key)
            except NoProfileError as error:
                write_no_surface(product, str(error), self.key)
        return InspectedProduct(product.grid.rows)


def inspection_key(config: SurfaceConfig) -> str:
    """Hash of how surfaces are inspected, the section included.

    Raises:
        FileFormatError: the section cannot be read.
    """
    section = _section_of(config)
    return key_of(asdict(config), None if section is None else asdict(section))


def is_inspected(product: Path | str, key: str) -> bool:
    """Whether a product has the surface of this key."""
    return surface_metadata(product).get("key") == key


def _section_of(config: SurfaceConfig) -> Section | None:
    return None if config.reference == "scan" else read_section(config.reference)


def inspect_product(
    product: Product, config: SurfaceConfig, advance: Callable[[int], None] = lambda rows: None, key: str = ""
) -> Inspection:
    """Inspect a product, on one thread: the bits are the same wherever it runs.

    Args:
        advance: takes the number of rows that were done. key: kept with the surface.

    Raises:
        NoProfileError: it shows no profile.
        FileFormatError: it is damaged, or the section cannot be read.
    """
    section = _section_of(config)
    with one_torch_thread():
        try:
            plan = SurfacePlan.of(product, config)
        except NoProfileError as error:
            raise NoProfileError(f"{product.path}: {error}") from None
        metadata = _metadata(product, plan, config) | {"key": key}
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
