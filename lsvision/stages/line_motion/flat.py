"""Lines of a flat object: its profile alone, and what its straight edges show of the sideways motion it does not show.

The profile that lines were registered to first may hold what lies beside the object, as a conveyor, which does not move
with it: the steps to it are no profile of the object. The trend of a pitched sheet would count as motion that is there.
"""

from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import ProductFrame, without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.edges.measured import finished, measure_edges, with_edges
from lsvision.stages.line_motion.estimated import Estimated, level_of
from lsvision.stages.line_motion.lasting_waves import trend_of_waves
from lsvision.stages.line_motion.profiles import Reference
from lsvision.stages.line_motion.registration import register_scan
from lsvision.types import DepthSource, LineMotion, Scan


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
    used = both.valid & edges.seen
    motion = finished(both.motion, edges, without_trend(both.along, used))
    return replace(both, motion=_with_trend(motion, both.along, edges.memory, used))


def _with_trend(
    motion: LineMotion, along: Float[Tensor, " lines"], memory: float, used: Bool[Tensor, " lines"]
) -> LineMotion:
    """With the trend of δx that its waves have over the object, where it consists of waves."""
    sideways = motion.findings[0]
    if sideways.state != "corrected":
        return motion
    trend = trend_of_waves(along, motion.values[:, :2], motion.sigma[:, :2], memory, used)
    if trend is None:
        return motion
    place = along - along[used].mean()
    values, covariance = motion.values.clone(), motion.covariance.clone()
    values[:, 0] += trend.slope[0] * place
    covariance[:, 0, 0] += trend.variance[0] * place.square()
    rms, variance = values[used, 0].square().mean().sqrt(), covariance[used, 0, 0].mean()
    sideways = replace(sideways, rms=float(rms), sigma=float(variance.sqrt()), waves=trend.waves)
    return replace(motion, values=values, covariance=covariance, findings=(sideways, *motion.findings[1:]))
