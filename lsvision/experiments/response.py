"""``+experiment=response``: references -> the response of the cameras, applied where their scans are read."""

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import polars
import torch

from lsvision import __version__
from lsvision.errors import ConfigError, ResponseError
from lsvision.experiments.archive_response import measure_archive
from lsvision.experiments.settings import RunSettings, settings_sha256
from lsvision.geometry import Camera
from lsvision.io import (
    read_scan,
    rig_file,
    scan_sha256,
    write_json,
    write_parquet,
    write_response,
    write_rig_with_response,
)
from lsvision.report.response_pages import response_in_words, response_report
from lsvision.schema import Text
from lsvision.stages.response.archive import Offsets
from lsvision.stages.response.config import ResponseConfig
from lsvision.stages.response.measured import MeasuredResponse, evened
from lsvision.stages.response.references import Reference, measure_dark, measure_references
from lsvision.stages.response.still import shared_structure
from lsvision.types import LineImage, Scan, StereoPair

log = logging.getLogger(__name__)

RESPONSE_FORMAT = "lsvision-response/1"


@dataclass(frozen=True, kw_only=True)
class ResponseSettings(RunSettings):
    """Options of the experiment: the scans of a dark reference and of a white one that moves, or an archive.

    ``archive`` is a folder of scans, or what else ``reprocess`` takes, of which ``calibration`` has the motion; a dark
    reference may go with it.
    """

    dark: Text | None = None
    white: Text | None = None
    archive: Text | None = None
    calibration: Text | None = None
    estimate: ResponseConfig = field(default_factory=ResponseConfig)


def run_response(settings: ResponseSettings, folder: Path) -> None:
    """Measure; write a TIFF of each camera, ``response.json``, a table of all columns, a rig file and the report.

    Raises:
        ResponseError: the references cannot be used; says why.
    """
    if settings.archive is not None:
        found = _from_archive(settings, folder)
    elif settings.dark is not None and settings.white is not None:
        dark, white = (read_scan(path, as_taken=True) for path in (settings.dark, settings.white))
        measured = measure_pair(dark, white, settings.estimate)
        found = Found("references", measured, [dark.path, white.path])
    else:
        raise ConfigError("dark, white: expected the scans of both references, dark=DIR white=DIR, or archive=DIR")
    files = write_responses(found.measured, folder)
    write_rig_with_response(rig_file(found.scans[-1]), folder / "rig.yaml", files)
    provenance = {
        "version": __version__,
        "config_sha256": settings_sha256(settings),
        "scans": [{"path": str(path), "sha256": scan_sha256(path)} for path in found.scans],
    }
    summary = {str(camera): summary_of(item) for camera, item in found.measured.items()}
    data = {"format": RESPONSE_FORMAT, "method": found.method, "files": files, **summary, **found.limits}
    write_json(folder / "response.json", {**data, "provenance": provenance})
    response_report(found.measured, found.in_words, asdict(settings), folder)
    for line in response_in_words(found.measured):
        log.info("%s", line)
    log.info(
        "wrote %s: put them, with rig.yaml, beside the scans", " and ".join(str(folder / n) for n in files.values())
    )


@dataclass(frozen=True)
class Found:
    """What was measured: how, the responses by camera, the scans they come from, and what limits them, by name."""

    method: str
    measured: dict[Camera, MeasuredResponse]
    scans: list[Path]
    limits: dict[str, Any] = field(default_factory=dict)

    @property
    def in_words(self) -> str:
        """How it was measured."""
        if not self.limits:
            return self.method
        longest = self.limits["observed_px"]
        return f"an archive: of waves up to {longest:.0f} columns; longer ones, as vignetting, are left as they are"


def _from_archive(settings: ResponseSettings, folder: Path) -> Found:
    if settings.archive is None or settings.calibration is None or settings.white is not None:
        raise ConfigError("archive: expected calibration=FILE with it, dark=DIR or not, and no white reference")
    config, offsets = settings.estimate, Offsets({})
    if settings.dark is not None:
        images = images_of(read_scan(settings.dark, as_taken=True))
        dark = {camera: measure_dark(Reference(image, settings.dark), config) for camera, image in images.items()}
        offsets = Offsets(dark)
    found = measure_archive(settings.archive, settings.calibration, offsets, config, folder)
    limits = {"observed_px": found.observed_px, "wander_px": found.wander_px}
    log.info("gains of waves up to %.0f columns; longer ones, as vignetting, are left as they are", found.observed_px)
    return Found("archive", found.measured, found.scans, limits)


def measure_pair(dark: Scan, white: Scan, config: ResponseConfig) -> dict[Camera, MeasuredResponse]:
    """The responses of the cameras of two scans, with the gains of both relative to one white.

    Raises:
        ResponseError: a reference cannot be one, or did not move.
    """
    darks, whites = images_of(dark), images_of(white)
    if darks.keys() != whites.keys():
        raise ResponseError(f"{dark.path}: expected the images {', '.join(whites)} as the white reference has")
    measured = {
        camera: measure_references(
            Reference(darks[camera], f"{dark.path}: {camera}"), Reference(image, f"{white.path}: {camera}"), config
        )
        for camera, image in whites.items()
    }
    if len(measured) == 2:
        shared = shared_structure(measured["left"].gain, measured["right"].gain)
        if shared is not None and shared.rms > config.largest_sigma:
            raise ResponseError(
                f"{white.path}: textured: a structure of {shared.rms:.1%} stands in the columns of both cameras, "
                f"{shared.disparity_px:+d} px apart: it is on the reference, which did not move"
            )
    return evened(measured)


def images_of(scan: Scan) -> dict[Camera, LineImage]:
    """The images of a scan by camera."""
    match scan.images:
        case StereoPair(left, right):
            return {"left": left, "right": right}
    return {"left": scan.left}


def write_responses(measured: Mapping[Camera, MeasuredResponse], folder: Path) -> dict[str, str]:
    """Write the response of each camera and the table of all; returns the TIFFs by camera."""
    files: dict[str, str] = {}
    for camera, item in measured.items():
        files[camera] = f"{camera}_response.tif"
        write_response(item.response, folder / files[camera])
    write_parquet(
        polars.concat([_table(camera, item) for camera, item in measured.items()]), folder / "response.parquet"
    )
    return files


def _table(camera: Camera, item: MeasuredResponse) -> polars.DataFrame:
    width, channels = item.gain.shape
    column, color = torch.meshgrid(torch.arange(width), torch.arange(channels), indexing="ij")
    values = {name: getattr(item, name).flatten().numpy() for name in ("offset", "offset_sigma", "gain", "gain_sigma")}
    places = {"column": column.flatten().numpy(), "channel": color.flatten().numpy()}
    return polars.DataFrame({"camera": [camera] * (width * channels), **places, **values})


def summary_of(item: MeasuredResponse) -> dict[str, object]:
    """What is known of a camera's response, as plain data; codes, and relative sigma."""
    seen = item.gain[~item.gain.isnan()]
    dark, white = item.noise
    return {
        "width_px": item.gain.shape[0],
        "channels": item.gain.shape[1],
        "lines": {"dark": item.lines[0], "white": item.lines[1]},
        "noise_codes": {"dark": dark, "white": white},
        "offset_codes": {"median": float(item.offset.median()), "sigma": float(item.offset_sigma.median())},
        "gain": {"lowest": float(seen.min()), "highest": float(seen.max()), "relative_sigma": item.relative_sigma},
        "blind_columns": item.gain.isnan().any(-1).nonzero()[:, 0].tolist(),
    }
