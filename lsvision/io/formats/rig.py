"""The rig file: ``rig.yaml``, and the same entries inside other files."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import yaml

from lsvision.geometry import Camera
from lsvision.io.atomic import write_text
from lsvision.io.formats.validation import read_entries, read_yaml
from lsvision.schema import Checked, Positive, PositiveInt, Text
from lsvision.types import Rig

RigFormat = Literal["lsvision-rig/1"]
RIG_FORMAT: RigFormat = "lsvision-rig/1"
CAMERAS: tuple[Camera, ...] = ("left", "right")


@dataclass(frozen=True)
class PrincipalPoints(Checked):
    """Entry ``principal_point_px``: the column that each camera's optical axis meets."""

    left: float
    right: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.right <= self.left:  # no plane in front of the cameras has zero disparity
            raise self.fault("right", f"expected a finite number > {self.left:g}, got {self.right}")


@dataclass(frozen=True)
class ColorSpacing(Checked):
    """Entry ``color_spacing_lines``: where the sensor line of each colour looks along Y, in nominal lines."""

    red: float
    green: float
    blue: float


@dataclass(frozen=True)
class ResponseFiles(Checked):
    """Entry ``response``: the file of each camera's response, relative to ``rig.yaml``; None for an even camera."""

    left: Text | None = None
    right: Text | None = None

    @property
    def named(self) -> dict[str, str]:
        """The files by camera."""
        return {camera: name for camera, name in asdict(self).items() if name is not None}


@dataclass(frozen=True, kw_only=True)
class PairEntries(Checked):
    """The entries of any pair of line cameras."""

    width_px: PositiveInt
    pixel_pitch_um: Positive
    baseline_mm: Positive
    color_spacing_lines: ColorSpacing | None = None
    response: ResponseFiles | None = None

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Colour spacing of red, green and blue, lines."""
        spacing = self.color_spacing_lines
        return (0.0, 0.0, 0.0) if spacing is None else (spacing.red, spacing.green, spacing.blue)


@dataclass(frozen=True, kw_only=True)
class RigEntries(PairEntries):
    """The entries of ``rig.yaml``."""

    format: RigFormat
    focal_length_mm: Positive
    principal_point_px: PrincipalPoints

    def rig(self) -> Rig:
        """The rig that they describe."""
        return Rig(
            width_px=self.width_px,
            pixel_pitch_um=self.pixel_pitch_um,
            focal_length_mm=self.focal_length_mm,
            baseline_mm=self.baseline_mm,
            principal_left_px=self.principal_point_px.left,
            principal_right_px=self.principal_point_px.right,
            color_spacing_lines=self.spacing,
        )


def read_rig(path: Path | str) -> Rig:
    """Read ``rig.yaml``.

    Raises:
        FileFormatError: the file is missing, or an entry is missing, unknown or out of range.
    """
    path = Path(path)
    return rig_from_dict(read_yaml(path), path)


def write_rig(rig: Rig, path: Path | str) -> None:
    """Write ``rig.yaml``."""
    write_text(path, yaml.safe_dump(rig_to_dict(rig), sort_keys=False, default_flow_style=None))


def rig_to_dict(rig: Rig) -> dict[str, object]:
    """Plain data of a rig, as ``rig.yaml`` holds it; the colour spacing only where there is one."""
    return {
        "format": RIG_FORMAT,
        "width_px": rig.width_px,
        "pixel_pitch_um": rig.pixel_pitch_um,
        "focal_length_mm": rig.focal_length_mm,
        "baseline_mm": rig.baseline_mm,
        "principal_point_px": asdict(PrincipalPoints(rig.principal_left_px, rig.principal_right_px)),
        **spacing_to_dict(rig.color_spacing_lines),
    }


def spacing_to_dict(color_spacing_lines: tuple[float, float, float]) -> dict[str, object]:
    """Entry ``color_spacing_lines``; none where all colours see the same line."""
    return {"color_spacing_lines": asdict(ColorSpacing(*color_spacing_lines))} if any(color_spacing_lines) else {}


def rig_from_dict(data: object, path: Path, where: str = "") -> Rig:
    """Check the plain data of a rig and make the rig.

    Args:
        data: what was read from ``path``.
        where: key of the rig within the file ("rig"); empty for a file of its own.

    Raises:
        FileFormatError: an entry is missing, unknown or out of range.
    """
    return read_entries(RigEntries, data, path, where).rig()
