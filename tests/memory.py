"""Peak memory of this program alone."""

import re
import resource
from pathlib import Path


def peak_memory_mb() -> float:
    """The most memory that this process has held since its program began, MB.

    ``ru_maxrss`` is no such figure where the kernel keeps it over ``exec``: it begins with the peak of the process that
    started this one, a test worker's 2 GB.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return int(re.findall(r"VmHWM:\s+(\d+) kB", status.read_text())[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
