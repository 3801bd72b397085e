"""Options of a simulated scan: scene, motion, sensor, encoder."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SceneConfig:
    """The object under the cameras.

    A board or sheet is turned by ``R = Rz(yaw) Ry(roll) Rx(pitch)`` about its centre, which crosses the scan plane
    midway between the cameras, ``depth_offset_mm`` behind the plane of zero disparity, on the middle line. A rail runs
    along the motion and can only roll about it; its crown lies ``rail_rise_mm`` above that depth. The conveyor is a
    plane along the motion, ``conveyor_drop_mm`` behind the plane of zero disparity, and is hidden by any target.
    """

    kind: str = "board"  # board, sheet or rail
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    depth_offset_mm: float = 0.0
    margin_mm: float = 20.0  # conveyor seen before and after a board or sheet
    texture_mm: float = 0.4  # finest detail of every surface
    board_border_x_mm: float = 20.0  # white beside the squares; a GP400 plate measures 400 x 300 mm
    board_border_y_mm: float = 15.0
    board_texture: float = 0.06  # relative contrast on the board
    sheet_width_mm: float = 360.0
    sheet_height_mm: float = 270.0
    rail_length_mm: float = 400.0
    rail_rise_mm: float = 22.0
    rail_texture: float = 0.16
    defect_spacing_mm: float = 120.0  # one scratch and one pit in each such length of rail; 0 for a flawless rail
    roll_mark_period_mm: float = 150.0  # circumference of the damaged roll; 0 for none
    conveyor_drop_mm: float = 26.0
    seed: int = 0


@dataclass(frozen=True)
class MotionConfig:
    """Motion of the object: a constant direction and stretch, and a smooth vibration of zero mean.

    The amplitudes are rms values. Each of x, z and roll is a sum of equal sine waves of the listed wavelengths (in mm
    of nominal travel) with phases drawn from the seed. Roll turns the object about the axis along Y midway between the
    cameras on the plane of zero disparity.
    """

    angle_x_deg: float = 0.0  # atan2(n1, n2)
    angle_z_deg: float = 0.0  # atan2(n3, n2)
    stretch: float = 1.0
    vibration_x_mm: float = 0.0
    vibration_z_mm: float = 0.0
    vibration_roll_deg: float = 0.0
    vibration_wavelengths_mm: list[float] = field(default_factory=lambda: [233.0, 97.0, 61.0])
    seed: int = 0


@dataclass(frozen=True)
class SensorConfig:
    """The pair of line sensors and the optics before them."""

    noise: float = 1.5  # standard deviation, of 255
    blur_px: float = 0.6  # standard deviation of the optics' point spread
    exposure: float = 0.95  # grey value, of 1, of a perfectly white surface facing the cameras midway
    bits: int = 8  # 8 or 16
    mono: bool = False
    supersampling: int = 3  # samples per pixel along the sensor, and per line along the motion
    color_registered: bool = True  # the camera has shifted its colour lines by their nominal spacing
    seed: int = 0


@dataclass(frozen=True)
class EncoderConfig:
    """Unevenly triggered lines and the encoder's log of their positions.

    If ``enabled``, the true nominal position of a line swings by ``wobble_mm`` (rms) about the constant pitch. The log
    is the true position plus white noise of ``noise_mm``.
    """

    enabled: bool = False
    wobble_mm: float = 0.3
    wobble_wavelengths_mm: list[float] = field(default_factory=lambda: [390.0, 151.0])
    noise_mm: float = 0.002
    seed: int = 0


@dataclass(frozen=True)
class BoardPose:
    """Tilt and depth of a board under the cameras, as in ``SceneConfig``."""

    pitch_deg: float
    roll_deg: float
    yaw_deg: float
    depth_offset_mm: float = 0.0
