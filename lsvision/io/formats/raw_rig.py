"""The file of a raw pair of cameras: ``rig.yaml`` of the format lsvision-rig/2."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import torch
import yaml

from lsvision.errors import FileFormatError
from lsvision.geometry import ideal_rig
from lsvision.io.atomic import write_text
from lsvision.io.formats.rig import RIG_FORMAT, PairEntries, RigEntries, spacing_to_dict
from lsvision.io.formats.validation import read_entries, read_yaml
from lsvision.schema import AcuteAngle, Checked, NonNegative, Positive, shown
from lsvision.types import RIG_QUANTITIES, RawCamera, RawRig, Rig, ViewPlane

RawRigFormat = Literal["lsvision-rig/2"]
RAW_RIG_FORMAT: RawRigFormat = "lsvision-rig/2"
_ROUNDING = 1e-6  # of a correlation


@dataclass(frozen=True)
class RawCameraEntries(Checked):
    """Entry ``left``, and what ``right`` has in common with it."""

    focal_length_mm: Positive
    principal_point_px: float
    turn_deg: AcuteAngle = 0.0
    distortion: tuple[float, float] = (0.0, 0.0)

    def camera(self) -> RawCamera:
        """The camera that they describe."""
        turn = math.radians(self.turn_deg)
        return RawCamera(self.focal_length_mm, self.principal_point_px, turn, self.distortion)


@dataclass(frozen=True)
class RightCameraEntries(RawCameraEntries):
    """Entry ``right``: the plane that it looks at, seen from the left camera's, too."""

    view_plane: ViewPlane = field(default_factory=ViewPlane)


@dataclass(frozen=True, kw_only=True)
class RawRigEntries(PairEntries):
    """The entries of ``rig.yaml``; ``sigma`` holds what is known of the quantities named in ``RIG_QUANTITIES``.

    ``covariance`` is that of all of them, in their order and units, and replaces ``sigma`` where it is given.
    """

    format: RawRigFormat
    left: RawCameraEntries
    right: RightCameraEntries
    sigma: dict[str, NonNegative] | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in sorted(set(self.sigma or {}) - set(RIG_QUANTITIES)):
            raise self.fault(f"sigma.{name}", f"unknown key; the quantities are {', '.join(RIG_QUANTITIES)}")
        problem = None if self.covariance is None else _covariance_problem(self.covariance)
        if problem:
            raise self.fault("covariance", problem)

    def rig(self) -> RawRig:
        """The rig that they describe."""
        return RawRig(
            width_px=self.width_px,
            pixel_pitch_um=self.pixel_pitch_um,
            baseline_mm=self.baseline_mm,
            left=self.left.camera(),
            right=self.right.camera(),
            view_plane=self.right.view_plane,
            color_spacing_lines=self.spacing,
            sigma=tuple(sorted((self.sigma or {}).items())),
            covariance=self.covariance,
        )


def _covariance_problem(rows: tuple[tuple[float, ...], ...]) -> str | None:
    """What keeps rows from being a covariance of all quantities."""
    size = len(RIG_QUANTITIES)
    if len(rows) != size or any(len(row) != size for row in rows):
        return f"expected {size} rows of {size} numbers"
    matrix = torch.tensor(rows, dtype=torch.float64)
    scale = matrix.diagonal().clamp(min=0).sqrt()
    if bool((matrix - matrix.mT).abs().gt(_ROUNDING * torch.outer(scale, scale)).any()):
        return "expected a symmetric matrix"
    known = scale > 0
    correlation = (matrix / torch.outer(scale, scale))[known][:, known]
    if bool((matrix.diagonal() < 0).any()) or float(torch.linalg.eigvalsh(correlation)[:1].sum()) < -_ROUNDING:
        return "expected a positive semidefinite matrix"
    return None


@dataclass(frozen=True)
class RigPair:
    """The pair of a rig file; where that holds a raw one, ``rig`` is the ideal pair that follows from it.

    ``response`` are the files of the cameras' responses by camera, as the rig file names them.
    """

    rig: Rig
    raw: RawRig | None
    response: Mapping[str, str] = field(default_factory=dict)

    @property
    def image_width_px(self) -> int:
        """Columns of the images."""
        return (self.raw or self.rig).width_px


def read_rig_pair(path: Path | str) -> RigPair:
    """Read ``rig.yaml`` of either format.

    Raises:
        FileFormatError: the file is missing, of neither format, or an entry is missing, unknown or out of range.
    """
    path = Path(path)
    data = read_yaml(path)
    format_ = data.get("format") if isinstance(data, Mapping) else None
    if format_ == RAW_RIG_FORMAT:
        of_raw = read_entries(RawRigEntries, data, path)
        raw = of_raw.rig()
        try:
            return RigPair(ideal_rig(raw), raw, of_raw.response.named if of_raw.response else {})
        except ValueError as error:
            raise FileFormatError(path, str(error)) from None
    if format_ is not None and format_ != RIG_FORMAT:
        problem = f"expected {RIG_FORMAT} or {RAW_RIG_FORMAT}, got {shown(format_)}"
        raise FileFormatError(path, problem, "format")
    entries = read_entries(RigEntries, data, path)
    return RigPair(entries.rig(), None, entries.response.named if entries.response else {})


def read_raw_rig(path: Path | str) -> RawRig:
    """Read ``rig.yaml`` of a raw pair.

    Raises:
        FileFormatError: the file is missing, or an entry is missing, unknown or out of range.
    """
    path = Path(path)
    return raw_rig_from_dict(read_yaml(path), path)


def write_raw_rig(rig: RawRig, path: Path | str, response: Mapping[str, str] | None = None) -> None:
    """Write ``rig.yaml`` of a raw pair, with the files of the cameras' responses by camera, relative to it."""
    entries = raw_rig_to_dict(rig) | ({"response": dict(response)} if response else {})
    write_text(path, yaml.safe_dump(entries, sort_keys=False, default_flow_style=None))


def raw_rig_to_dict(rig: RawRig) -> dict[str, object]:
    """Plain data of a raw rig, as ``rig.yaml`` holds it."""
    left, right = (
        {
            "focal_length_mm": camera.focal_length_mm,
            "principal_point_px": camera.principal_px,
            "turn_deg": math.degrees(camera.turn_rad),
            "distortion": list(camera.distortion),
        }
        for camera in (rig.left, rig.right)
    )
    return {
        "format": RAW_RIG_FORMAT,
        "width_px": rig.width_px,
        "pixel_pitch_um": rig.pixel_pitch_um,
        "baseline_mm": rig.baseline_mm,
        "left": left,
        "right": {**right, "view_plane": asdict(rig.view_plane)},
        **spacing_to_dict(rig.color_spacing_lines),
        **({"sigma": dict(rig.sigma)} if rig.sigma else {}),
        **({"covariance": [list(row) for row in rig.covariance]} if rig.covariance else {}),
    }


def raw_rig_from_dict(data: object, path: Path, where: str = "") -> RawRig:
    """Check the plain data of a raw rig and make the rig; see ``rig_from_dict``.

    Raises:
        FileFormatError: an entry is missing, unknown or out of range.
    """
    return read_entries(RawRigEntries, data, path, where).rig()
