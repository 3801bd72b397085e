"""What a product says about the motion from line to line, in words."""

from collections.abc import Iterator, Mapping
from typing import Any

_ORIGINS = {
    "none": "not corrected",
    "measured": "measured on the object's profile",
    "log": "from the scan's own log",
    "file": "from the given file",
}


def line_motion_words(metadata: Mapping[str, Any]) -> Iterator[str]:
    """One line on where it came from, one on each component, and on the section and what may be shape instead.

    Args:
        metadata: the entry ``line_motion`` of a product's metadata.
    """
    source = str(metadata.get("source", "none"))
    components = metadata.get("components", ())
    edges = " and straight edges" if source == "measured" and any(each.get("edges") for each in components) else ""
    yield f"motion from line to line: {_ORIGINS.get(source, source)}{edges}"
    for component in components:
        yield f"  {component['in_words']}"
    if metadata.get("section"):
        yield f"  {metadata['section']['in_words']}"
    if metadata.get("note"):
        yield f"  {metadata['note']}"
