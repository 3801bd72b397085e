"""Options of a simulated scan: scene, motion, sensor, encoder."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le, Lt

from lsvision.schema import AcuteAngle, Checked, Interval, NonNegative, Positive, PositiveInt, Seed, Share, Wavelengths

Lights = Literal["beside", "along"]


@dataclass(frozen=True)
class SceneConfig(Checked):
    """The object under the cameras.

    A board or sheet is turned by ``R = Rz(yaw) Ry(roll) Rx(pitch)`` about its centre, which crosses the scan plane
    midway between the cameras, ``depth_offset_mm`` behind the plane of zero disparity, on the middle line. A rail runs
    along the motion and can only roll about it; its crown has the height ``rail_rise_mm`` in the product frame, counted
    from that depth. A corrugated rail rises and falls by ``corrugation_mm`` in a wave of ``corrugation_wavelength_mm``,
    whose phase is drawn from the seed and whose crests lie along the scan lines. The conveyor is a plane along the
    motion at the height ``-conveyor_drop_mm``; any target hides it.

    A ``white`` reference is an endless white plane along the motion at that depth, with specks of dirt of about
    ``dirt_mm`` on ``dirt_share`` of it; ``dark`` is a scan without light. Their length is ``rail_length_mm``, too.

    ``lights`` stand ``beside`` the cameras, parallel to the motion, or ``along`` the sensor line, as on machines. Steel
    of ``rail_gloss`` reflects them besides, each by that share of a white surface's brightness at most, the more
    narrowly the larger ``rail_sharpness``: each camera sees the reflections at other places.
    """

    kind: Literal["board", "sheet", "rail", "white", "dark"] = "board"
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    depth_offset_mm: float = 0.0
    margin_mm: NonNegative = 20.0  # conveyor seen before and after a board or sheet
    texture_mm: Positive = 0.4  # finest detail of every surface
    board_border_x_mm: NonNegative = 20.0  # white beside the squares; a GP400 plate measures 400 x 300 mm
    board_border_y_mm: NonNegative = 15.0
    board_texture: NonNegative = 0.06  # relative contrast on the board
    sheet_width_mm: Positive = 360.0
    sheet_height_mm: Positive = 270.0
    sheet_frame: bool = True  # printed along its sides, with a ruler
    rail_length_mm: Positive = 400.0
    rail_rise_mm: float = 22.0  # of the crown over the plane of zero disparity
    rail_texture: NonNegative = 0.16
    corrugation_mm: NonNegative = 0.0  # amplitude; 0: the same height all along
    corrugation_wavelength_mm: Positive = 80.0
    defect_spacing_mm: NonNegative = 120.0  # one scratch and one pit per length of rail; 0: none
    pit_radius_mm: Interval = (2.0, 4.5)  # from which that of each pit is drawn, and its depth from the next
    pit_depth_mm: Interval = (0.4, 1.0)
    roll_mark_period_mm: NonNegative = 150.0  # circumference of the damaged roll; 0: none
    conveyor_drop_mm: float = 26.0  # of the conveyor under the plane of zero disparity
    dirt_share: Share = 0.02  # of a white reference
    dirt_mm: Positive = 1.5
    lights: Lights = "beside"
    rail_gloss: NonNegative = 0.0  # 0: matt
    rail_sharpness: Positive = 60.0
    seed: Seed = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("pitch_deg", "yaw_deg"):
            if self.is_endless and getattr(self, key) != 0:
                raise self.fault(key, f"expected 0, as a {self.kind} runs along the motion, got {getattr(self, key)}")

    @property
    def is_endless(self) -> bool:
        """Whether the object is the same along the whole scan."""
        return self.kind in ("rail", "white", "dark")


@dataclass(frozen=True)
class MotionConfig(Checked):
    """Motion of the object: a constant direction and stretch, and a smooth vibration of zero mean.

    The amplitudes are rms values. Each of x, z and roll is a sum of equal sine waves of the listed wavelengths (in mm
    of nominal travel) with phases drawn from the seed. Roll turns the object about the axis along Y midway between the
    cameras on the plane of zero disparity.
    """

    angle_x_deg: AcuteAngle = 0.0  # atan2(n1, n2)
    angle_z_deg: AcuteAngle = 0.0  # atan2(n3, n2)
    stretch: Positive = 1.0
    vibration_x_mm: NonNegative = 0.0
    vibration_z_mm: NonNegative = 0.0
    vibration_roll_deg: NonNegative = 0.0
    vibration_wavelengths_mm: Wavelengths = (233.0, 97.0, 61.0)
    seed: Seed = 0


@dataclass(frozen=True)
class SensorConfig(Checked):
    """The pair of line sensors and the optics before them.

    A raw code is ``gain`` times that of an even camera, plus an offset. The gain falls off along the line by
    ``vignetting`` from its middle to its ends, by the square of the distance; every column and colour departs from that
    by ``gain_noise``, and from ``offset`` by ``offset_noise`` (standard deviations).

    Lenses are in focus ``focus_height_mm`` over the plane of zero disparity, positive towards the cameras. A point that
    lies off by 1 mm is blurred by ``defocus_px_per_mm`` (standard deviation) besides, up to 3 px.
    """

    noise: NonNegative = 1.5  # standard deviation, of 255
    blur_px: NonNegative = 0.6  # standard deviation of the optics' point spread
    exposure: Positive = 0.95  # grey value, of 1, of a perfectly white surface facing the cameras midway
    bits: Literal[8, 16] = 8
    mono: bool = False
    supersampling: PositiveInt = 3  # samples per pixel along the sensor, and per line along the motion
    color_registered: bool = True  # the camera has shifted its colour lines by their nominal spacing
    vignetting: Annotated[float, Ge(0), Lt(1)] = 0.0  # share of the light lost at the ends of the line
    gain_noise: Annotated[float, Ge(0), Lt(0.2)] = 0.0  # relative
    offset: NonNegative = 0.0  # grey values, of 255
    offset_noise: NonNegative = 0.0
    defocus_px_per_mm: NonNegative = 0.0
    focus_height_mm: float = 0.0
    seed: Seed = 0

    @property
    def is_even(self) -> bool:
        """Whether all columns respond alike, without an offset."""
        return not (self.vignetting or self.gain_noise or self.offset or self.offset_noise)


@dataclass(frozen=True)
class EncoderConfig(Checked):
    """Unevenly triggered lines and the encoder's log of their positions.

    If ``enabled``, the true nominal position of a line swings by ``wobble_mm`` (rms) about the constant pitch. The log
    is that position plus white noise of ``noise_mm``. Whether or not it is enabled, every line is triggered off its
    place by a ``jitter`` (rms, as a share of the line pitch) that no log shows.
    """

    enabled: bool = False
    wobble_mm: NonNegative = 0.3
    wobble_wavelengths_mm: Wavelengths = (390.0, 151.0)
    noise_mm: NonNegative = 0.002
    jitter: Annotated[float, Ge(0), Le(0.2)] = 0.0
    seed: Seed = 0


@dataclass(frozen=True)
class BoardPose(Checked):
    """Tilt and depth of a board under the cameras, as in ``SceneConfig``."""

    pitch_deg: float
    roll_deg: float
    yaw_deg: float
    depth_offset_mm: float = 0.0
