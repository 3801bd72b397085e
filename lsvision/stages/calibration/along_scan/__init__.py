"""Errors that all corners of a line share, as of vibration or of the encoder: found, weighed in the estimate, reported.

The rest of the stage knows them by ``by_chance`` (whether to look), ``errors_along_scan`` (a batch of problems, with
the noise that the errors make), and ``search``, ``Linearised``, ``latents`` (one problem, beside other hypotheses).
"""

from lsvision.stages.calibration.along_scan.all_kernels import most_probable_errors, search_with_edges
from lsvision.stages.calibration.along_scan.check import SUSPICION, by_chance
from lsvision.stages.calibration.along_scan.edges import EdgeRows, edge_rows
from lsvision.stages.calibration.along_scan.errors import ErrorsAlongScan, errors_along_scan, with_processes
from lsvision.stages.calibration.along_scan.evidence import Linearised, NormalEquations
from lsvision.stages.calibration.along_scan.kernels import FINE, SEARCHED
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Lever, Travel, latents
from lsvision.stages.calibration.along_scan.posterior import Processes, processes_given_corners
from lsvision.stages.calibration.along_scan.search import Beforehand, FoundErrors, search
from lsvision.stages.calibration.along_scan.spectrum import Spectrum

__all__ = [
    "COMPONENTS",
    "FINE",
    "SEARCHED",
    "SUSPICION",
    "Beforehand",
    "EdgeRows",
    "ErrorsAlongScan",
    "FoundErrors",
    "Lever",
    "Linearised",
    "NormalEquations",
    "Processes",
    "Spectrum",
    "Travel",
    "by_chance",
    "edge_rows",
    "errors_along_scan",
    "latents",
    "most_probable_errors",
    "processes_given_corners",
    "search",
    "search_with_edges",
    "with_processes",
]
