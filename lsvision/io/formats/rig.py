"""The rig file: ``rig.yaml``, and the same entries inside other files."""

from pathlib import Path

import yaml

from lsvision.io.atomic import write_text
from lsvision.io.formats.validation import Fields, read_yaml
from lsvision.types import Rig

RIG_FORMAT = "lsvision-rig/1"
_COLORS = ("red", "green", "blue")


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
    data: dict[str, object] = {
        "format": RIG_FORMAT,
        "width_px": int(rig.width_px),
        "pixel_pitch_um": float(rig.pixel_pitch_um),
        "focal_length_mm": float(rig.focal_length_mm),
        "baseline_mm": float(rig.baseline_mm),
        "principal_point_px": {"left": float(rig.principal_left_px), "right": float(rig.principal_right_px)},
    }
    if any(rig.color_spacing_lines):
        data["color_spacing_lines"] = dict(zip(_COLORS, map(float, rig.color_spacing_lines), strict=True))
    return data


def rig_from_dict(data: object, path: Path, key_prefix: str = "") -> Rig:
    """Check the plain data of a rig and make the rig.

    Args:
        data: what was read from ``path``.
        key_prefix: where it stands in the file, with a dot at its end ("rig.").

    Raises:
        FileFormatError: an entry is missing, unknown or out of range.
    """
    fields = Fields(path, data, key_prefix)
    fields.choice("format", RIG_FORMAT)
    principal = fields.section("principal_point_px")
    left = principal.number("left")
    rig = Rig(
        width_px=fields.integer("width_px", at_least=1),
        pixel_pitch_um=fields.number("pixel_pitch_um", above=0),
        focal_length_mm=fields.number("focal_length_mm", above=0),
        baseline_mm=fields.number("baseline_mm", above=0),
        principal_left_px=left,
        principal_right_px=principal.number("right", above=left),  # else no plane in front has zero disparity
        color_spacing_lines=_color_spacing(fields),
    )
    principal.finish()
    fields.finish()
    return rig


def _color_spacing(fields: Fields) -> tuple[float, float, float]:
    if not fields.has("color_spacing_lines"):
        return 0.0, 0.0, 0.0
    spacing = fields.section("color_spacing_lines")
    red, green, blue = (spacing.number(color) for color in _COLORS)
    spacing.finish()
    return red, green, blue
