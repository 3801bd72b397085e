"""The file of a raw pair of cameras: ``rig.yaml`` of the format lsvision-rig/2."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import yaml

from lsvision.errors import FileFormatError
from lsvision.geometry import ideal_rig
from lsvision.io.atomic import write_text
from lsvision.io.formats.rig import RIG_FORMAT, ColorSpacing, ResponseFiles, RigEntries
from lsvision.io.formats.validation import read_entries, read_yaml
from lsvision.schema import AcuteAngle, Checked, NonNegative, Positive, PositiveInt, shown
from lsvision.types import RIG_QUANTITIES, RawCamera, RawRig, Rig, ViewPlane

RawRigFormat = Literal["lsvision-rig/2"]
RAW_RIG_FORMAT: RawRigFormat = "lsvision-rig/2"


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


@dataclass(frozen=True)
class RawRigEntries(Checked):
    """The entries of ``rig.yaml``; ``sigma`` holds what is known of the quantities named in ``RIG_QUANTITIES``."""

    format: RawRigFormat
    width_px: PositiveInt
    pixel_pitch_um: Positive
    baseline_mm: Positive
    left: RawCameraEntries
    right: RightCameraEntries
    color_spacing_lines: ColorSpacing | None = None
    sigma: dict[str, NonNegative] | None = None
    response: ResponseFiles | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in sorted(set(self.sigma or {}) - set(RIG_QUANTITIES)):
            raise self.fault(f"sigma.{name}", f"unknown key; the quantities are {', '.join(RIG_QUANTITIES)}")

    def rig(self) -> RawRig:
        """The rig that they describe."""
        spacing = self.color_spacing_lines or ColorSpacing(0.0, 0.0, 0.0)
        return RawRig(
            width_px=self.width_px,
            pixel_pitch_um=self.pixel_pitch_um,
            baseline_mm=self.baseline_mm,
            left=self.left.camera(),
            right=self.right.camera(),
            view_plane=self.right.view_plane,
            color_spacing_lines=(spacing.red, spacing.green, spacing.blue),
            sigma=tuple(sorted((self.sigma or {}).items())),
        )


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


def write_raw_rig(rig: RawRig, path: Path | str) -> None:
    """Write ``rig.yaml`` of a raw pair."""
    write_text(path, yaml.safe_dump(raw_rig_to_dict(rig), sort_keys=False, default_flow_style=None))


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
    spacing = {"color_spacing_lines": asdict(ColorSpacing(*rig.color_spacing_lines))}
    return {
        "format": RAW_RIG_FORMAT,
        "width_px": rig.width_px,
        "pixel_pitch_um": rig.pixel_pitch_um,
        "baseline_mm": rig.baseline_mm,
        "left": left,
        "right": {**right, "view_plane": asdict(rig.view_plane)},
        **(spacing if any(rig.color_spacing_lines) else {}),
        **({"sigma": dict(rig.sigma)} if rig.sigma else {}),
    }


def raw_rig_from_dict(data: object, path: Path, where: str = "") -> RawRig:
    """Check the plain data of a raw rig and make the rig; see ``rig_from_dict``.

    Raises:
        FileFormatError: an entry is missing, unknown or out of range.
    """
    return read_entries(RawRigEntries, data, path, where).rig()
