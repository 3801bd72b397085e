"""The frozen dataclasses that flow between the stages: the vocabulary that all packages share.

Units are millimetres, pixels and lines; angles are radians unless a name ends in ``_deg``. Pixel centres are integers.
Leading batch dimensions are written ``*batch``. Frames are those of the README's convention table: scan frame S, board
frame C, product frame M.
"""

from lsvision.types.calibration import (
    BoardCorners,
    BoardEdges,
    BoardFit,
    Calibration,
    CalibrationMethod,
    ErrorAlongScan,
    Iteration,
    Motion,
    Observability,
    ObservedDirection,
    Pose,
    Provenance,
    RefusedVerdict,
    Verdict,
    WhetherLineMotion,
)
from lsvision.types.installation import Installation, InstallationVerdict, LinePitch, PointShift, Turn
from lsvision.types.line_motion import LINE_COMPONENTS, LineComponent, LineFinding, LineMotion
from lsvision.types.product import (
    ProductGrid,
    ProductStrip,
)
from lsvision.types.raw_rig import RIG_QUANTITIES, RawCamera, RawRig, ViewPlane
from lsvision.types.response import CameraResponse
from lsvision.types.rig_calibration import CameraResiduals, RigBoard, RigCalibration, RigCombination, RigVerdict
from lsvision.types.scan import (
    Board,
    Depth,
    DepthSource,
    DepthView,
    LineImage,
    MissingLines,
    Rig,
    Scan,
    StereoPair,
    StoredDepth,
    TensorImage,
    Transport,
    Travel,
    missing_ranges,
)
from lsvision.types.section import Section, SectionFit
from lsvision.types.surface import Candidate, CandidateKind, HeadSide, MarkGroup, ProductSource, SectionWear

__all__ = [
    "LINE_COMPONENTS",
    "RIG_QUANTITIES",
    "Board",
    "BoardCorners",
    "BoardEdges",
    "BoardFit",
    "Calibration",
    "CalibrationMethod",
    "CameraResiduals",
    "CameraResponse",
    "Candidate",
    "CandidateKind",
    "Depth",
    "DepthSource",
    "DepthView",
    "ErrorAlongScan",
    "HeadSide",
    "Installation",
    "InstallationVerdict",
    "Iteration",
    "LineComponent",
    "LineFinding",
    "LineImage",
    "LineMotion",
    "LinePitch",
    "MarkGroup",
    "MissingLines",
    "Motion",
    "Observability",
    "ObservedDirection",
    "PointShift",
    "Pose",
    "ProductGrid",
    "ProductSource",
    "ProductStrip",
    "Provenance",
    "RawCamera",
    "RawRig",
    "RefusedVerdict",
    "Rig",
    "RigBoard",
    "RigCalibration",
    "RigCombination",
    "RigVerdict",
    "Scan",
    "Section",
    "SectionFit",
    "SectionWear",
    "StereoPair",
    "StoredDepth",
    "TensorImage",
    "Transport",
    "Travel",
    "Turn",
    "Verdict",
    "ViewPlane",
    "WhetherLineMotion",
    "missing_ranges",
]
