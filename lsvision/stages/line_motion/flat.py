"""Lines of a flat object: its profile alone, and what its straight edges show of the sideways motion it does not show.

The profile that lines were registered to first may hold what lies beside the object, as a conveyor, which does not move
with it: the steps to it are no profile of the object. The trend of a pitched sheet would count as motion that is there.
"""

from dataclasses import replace

from lsvision.geometry import ProductFrame, without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.edges.measured import finished, measure_edges, with_edges
from lsvision.stages.line_motion.estimated import Estimated, level_of
from lsvision.stages.line_motion.profiles import Reference
from lsvision.stages.line_motion.registration import register_scan
from lsvision.types import DepthSource, Scan


def measure_flat(
    scan: Scan,
    depth: DepthSource,
    profile: tuple[Reference, slice],
    seen: Estimated,
    frame: ProductFrame,
    config: LineMotionConfig,
) -> Estimated:
    """What the lines of a flat object show; ``seen``, where the object is not flat, or its profile shows all.

    Args:
        profile: that the lines were registered to, and the columns that show it. seen: what they showed.
    """
    reference, columns = profile
    flat = FlatObject.of(reference, frame)
    if flat is None or not bool(seen.valid.any()):
        return seen
    if flat.is_alone and seen.motion.findings[0].state != "not observed":
        return seen
    registered = register_scan(frame, depth, flat.profile, columns, config)
    samples = int(registered.lines.samples[seen.valid].median())
    level = level_of(registered, samples, frame, config)
    alone = Estimated.of(with_edges(None, registered, flat), samples, frame, config, level)
    edges = measure_edges(scan, flat, alone.motion, level, alone.valid, config)
    if isinstance(edges, str):
        sideways = alone.motion.findings[0]
        return alone.with_finding(replace(sideways, sigma=0.0, reason=f"{edges}, and {sideways.reason}"))
    both = Estimated.of(with_edges(edges, registered, flat), samples, frame, config, level)
    gauge = without_trend(both.along, both.valid & edges.seen)
    return replace(both, motion=finished(both.motion, edges, gauge))
