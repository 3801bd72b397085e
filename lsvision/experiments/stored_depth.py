"""The depth of a scan that is read several times."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from lsvision.archive.depth_store import create_depth_store, open_depth_store, write_depth
from lsvision.report.progress import progress_bars
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.types import Depth, DepthSource, DepthView, Scan


@contextmanager
def stored_depth(scan: Scan, depth: DepthSource, config: DisparityConfig, folder: Path) -> Iterator[DepthSource]:
    """The depth of a scan, which is read several times: matched once, into a store that is removed at the end."""
    if isinstance(scan.images, DepthView):
        yield depth
        return
    with TemporaryDirectory(prefix=".depth-", dir=folder) as temporary, progress_bars() as bars:
        store, step = Path(temporary) / "depth", config.work_lines
        create_depth_store(store, scan.lines, scan.rig.width_px, step, with_sigma=False)
        bar = bars.start(f"match {scan.path.name}", total=scan.lines)
        for start in range(0, scan.lines, step):
            part: Depth = depth.read(start, min(start + step, scan.lines))
            write_depth(str(store), start, part, with_sigma=False)
            bars.advance(bar, len(part.z))
        yield open_depth_store(str(store))
