"""``+experiment=validate``: re-read a product, every chunk against its checksum, and measure the board in it if any."""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path

from lsvision.experiments.settings import RunSettings
from lsvision.io import ProductImage, check_product, read_product, write_json
from lsvision.schema import Text
from lsvision.stages.measurement import measure_board
from lsvision.types import Board

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ValidateSettings(RunSettings):
    """Options of the experiment: a product, and the board that may be seen in it."""

    product: Text
    board: Board


def run_validate(settings: ValidateSettings, folder: Path) -> None:
    """Check the product, log what is in it and measure its board; a fault is an error that names the image and rows."""
    check = check_product(settings.product)
    product = read_product(settings.product)
    log.info(
        "%s is whole: %d x %d cells, %d levels, %.1f %% measured, heights %.3f..%.3f mm",
        settings.product, check.rows, check.columns, check.levels, 100 * check.valid_share,
        check.lowest_mm, check.highest_mm,
    )  # fmt: skip
    color, height = ProductImage(product, "color"), ProductImage(product, "height")
    board = measure_board(color, height, product.grid, settings.board)
    summary: dict[str, object] = asdict(check)
    if board is None:
        log.info("no board of %d x %d squares in it", settings.board.columns, settings.board.rows)
        summary["board"] = None
    else:
        found = int(board.valid.sum())
        log.info(
            "board: %d corners, distances off by %.4f mm rms between neighbours, %.4f mm between all",
            found, board.neighbour_rms_mm, board.distance_rms_mm,
        )  # fmt: skip
        summary["board"] = {
            "corners": found,
            "neighbour_rms_mm": board.neighbour_rms_mm,
            "distance_rms_mm": board.distance_rms_mm,
        }
    write_json(folder / "summary.json", summary)
