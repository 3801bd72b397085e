"""The points of a study as curves: one for each combination of conditions, with its label, colour and marker."""

from collections.abc import Sequence
from dataclasses import dataclass

import polars

from lsvision.report.drawing import COLORS

_MOST_CURVES = len(COLORS)
_MARKERS = "osD^vP*X"


@dataclass(frozen=True)
class Curve:
    """The points that share a combination of conditions."""

    label: str
    points: polars.DataFrame
    color: str
    marker: str


def curves_by(points: polars.DataFrame, conditions: Sequence[str]) -> list[Curve]:
    """One curve for each combination of the conditions, as many as a figure has colours; one of all without any."""
    if not conditions:
        return [Curve("rms error", points, COLORS[0], _MARKERS[0])]
    groups = list(points.group_by(*conditions, maintain_order=True))[:_MOST_CURVES]
    return [
        Curve(
            ", ".join(_in_words(name, value) for name, value in zip(conditions, values, strict=True)),
            own,
            color,
            marker,
        )
        for (values, own), color, marker in zip(groups, COLORS, _MARKERS, strict=False)
    ]


def omitted_curves(points: polars.DataFrame, conditions: Sequence[str]) -> str:
    """The last sentence of a caption whose figure does not show every combination; "" if it shows all."""
    count = points.select(conditions).unique().height if conditions else 1
    return f" Shown are the first {_MOST_CURVES} of {count} combinations." if count > _MOST_CURVES else ""


def _in_words(name: str, value: object) -> str:
    if name in ("boards", "method"):
        return str(value).replace("_", " ")
    if name == "line_motion":
        return "lines measured" if value == "auto" else "corners alone"
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
