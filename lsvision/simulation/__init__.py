"""Line-scan renderer: boards, printed sheets and rails in motion under a stereo rig, with the truth."""

from lsvision.simulation.artwork import artwork
from lsvision.simulation.config import BoardPose, EncoderConfig, MotionConfig, SceneConfig, SensorConfig
from lsvision.simulation.scan import Acquisition, Simulation, simulate
from lsvision.simulation.trajectory import Trajectory

__all__ = [
    "Acquisition",
    "BoardPose",
    "EncoderConfig",
    "MotionConfig",
    "SceneConfig",
    "SensorConfig",
    "Simulation",
    "Trajectory",
    "artwork",
    "simulate",
]
