"""The product frame M: the one place that knows where what a scan saw lies in its product.

The axes follow the motion n: e_y = n / ‖n‖, e_z = the viewing direction Z made orthogonal to e_y, e_x = e_y x e_z. What
column u sees at depth z on line v lies at

    q = z ray(u) + along(v) e_y,        ray(u) = slope(u) X + Z in the product's axes,   along(v) = ‖n‖ travel(v).

So q_x and q_z of a sample depend on its own line alone and do not grow with the line number: a scan of any length stays
in frame and is worked on strip by strip. With a the rows e_x, e_y, e_z, q_y of a sample follows from the other two:

    q_y = along(v) - (a_01 q_x + a_21 q_z) / a_11.

Heights are counted towards the cameras from c = (B/2, 0, z0), the middle of the plane of zero disparity:
height = q_z(c) - q_z. Kernels in single precision carry the **relief** instead, z0 - q_z, which differs from the height
by a constant of the frame (``height_over_relief_mm``).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.camera import focal_length_px, middle_point, slope_at, zero_disparity_mm
from lsvision.geometry.motion import line_at, scan_position, travel_at
from lsvision.types import Pose, Rig, Travel


def product_axes(n: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation that takes scan-frame vectors to the product frame; its rows are e_x, e_y and e_z."""
    e_y = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    z = torch.zeros_like(n)
    z[..., 2] = 1.0
    e_z = z - e_y[..., 2:3] * e_y
    e_z = e_z / torch.linalg.vector_norm(e_z, dim=-1, keepdim=True)
    e_x = torch.linalg.cross(e_y, e_z, dim=-1)
    return torch.stack([e_x, e_y, e_z], dim=-2)


def aligned_rotation(n: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation R_scan_from_product: turns an object so that its Y runs along the motion n."""
    return product_axes(n).mT


def product_pose(pose: Pose, n: Float[Tensor, "3"]) -> Pose:
    """A pose given in the scan frame, in the product frame of the motion n."""
    axes = product_axes(n)
    return Pose(axes @ pose.rotation, axes @ pose.translation)


def to_product(measured: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Product coordinates q, mm, of measured (x, y = travel, z), mm.

    Written per component, so that q_x and q_z stay exact however far the scan has travelled.
    """
    axes = product_axes(n)
    e_x, e_y, e_z = axes[..., 0, :], axes[..., 1, :], axes[..., 2, :]
    x, y, z = measured.unbind(-1)
    q_x = x * e_x[..., 0] + z * e_x[..., 2]
    q_y = torch.linalg.vector_norm(n, dim=-1) * y + x * e_y[..., 0] + z * e_y[..., 2]
    q_z = x * e_z[..., 0] + z * e_z[..., 2]
    return torch.stack([q_x, q_y, q_z], dim=-1)


def from_product(product: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Measured (x, y = travel, z), mm, of product coordinates q, mm: the inverse of ``to_product``."""
    return scan_position((product_axes(n).mT @ product[..., None])[..., 0], n)


def motion_sigma(n: Float[Tensor, "3"], covariance: Float[Tensor, "3 3"]) -> Float[Tensor, "3"]:
    """Standard deviation of n along e_x, e_y and e_z, from its covariance in the scan frame."""
    axes = product_axes(n)
    return (axes @ covariance @ axes.mT).diagonal().clamp(min=0).sqrt()


@dataclass(frozen=True)
class ProductFrame:
    """The product frame of one scan: between (column, line, depth) of the left image and (q_x, q_y, q_z), mm.

    Attributes:
        rig: the cameras. travel: of the scan.
        n: motion of the object, mm per nominal mm of travel, float64.
    """

    rig: Rig
    travel: Travel
    n: Float[Tensor, "3"]

    @cached_property
    def axes(self) -> Float[Tensor, "3 3"]:
        """Rows e_x, e_y and e_z in the scan frame."""
        return product_axes(self.n)

    @cached_property
    def stretch(self) -> Float[Tensor, ""]:
        """‖n‖: true over nominal travel."""
        return torch.linalg.vector_norm(self.n)

    @cached_property
    def height_datum_mm(self) -> float:
        """q_z of height zero: that of the middle c of the plane of zero disparity."""
        return float(self.axes[2] @ middle_point(self.rig).to(self.axes))

    @cached_property
    def height_over_relief_mm(self) -> float:
        """What to add to a relief z0 - q_z to get a height."""
        return self.height_datum_mm - zero_disparity_mm(self.rig)

    @cached_property
    def q_y_per_relief(self) -> float:
        """Change of q_y, mm per mm, with the relief of a sample on one line: a_21 / a_11."""
        return float(self.axes[2, 1] / self.axes[1, 1])

    @property
    def advance_mm(self) -> float:
        """Distance along the motion between lines one nominal line pitch apart."""
        return float(self.stretch) * self.travel.line_pitch_mm

    def ray(self, column: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Product coordinates of what a column of the left image sees, per mm of depth, less ``along`` e_y."""
        return slope_at(self.rig, column)[..., None] * self.axes[:, 0] + self.axes[:, 2]

    def along(self, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Distance, mm, that the object has moved along e_y at (fractional) lines."""
        return self.stretch * travel_at(self.travel, line)

    def line(self, along: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """(Fractional) line at which the object has moved a distance along e_y, mm: the inverse of ``along``."""
        return line_at(self.travel, along / self.stretch)

    def position(
        self, column: Float[Tensor, "*#batch"], line: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """(q_x, q_y, q_z), mm, of what a column of the left image sees at depth z, mm, on a line."""
        y_axis = self.n.new_tensor([0.0, 1.0, 0.0])
        return z[..., None] * self.ray(column) + self.along(line)[..., None] * y_axis

    def source(self, q: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """(column, line, z) of the left image that sees (q_x, q_y, q_z), mm: the inverse of ``position``."""
        x, y, z = from_product(q, self.n).unbind(-1)
        column = self.rig.principal_left_px + x / z * focal_length_px(self.rig)
        return torch.stack([column, line_at(self.travel, y), z], dim=-1)

    def q_y(
        self, along: Float[Tensor, "*#batch"], q_x: Float[Tensor, "*#batch"], relief: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """q_y, mm, of a sample of a line at ``along``, from its place across the line and its relief, mm."""
        return along - self.lag(q_x) + relief * self.q_y_per_relief

    def lag(self, q_x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """How far q_y of the samples of a line falls behind its ``along``, mm, at relief zero."""
        by_q_x, by_q_z = self.axes[0, 1] / self.axes[1, 1], self.axes[2, 1] / self.axes[1, 1]
        return q_x * by_q_x + zero_disparity_mm(self.rig) * by_q_z

    def depth(self, column: Float[Tensor, "*batch"], relief: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Depth z, mm, of what a column of the left image sees at a relief, mm."""
        return (zero_disparity_mm(self.rig) - relief) / self.ray(column)[..., 2]

    def offset_range(self, q_x: Float[Tensor, " places"], z: Float[Tensor, " depths"]) -> tuple[float, float]:
        """Least and greatest q_y, mm, less ``along``, of samples at places across the line and at depths, mm."""
        x = (q_x[:, None] - z * self.axes[0, 2]) / self.axes[0, 0]
        offset = x * self.axes[1, 0] + z * self.axes[1, 2]
        return float(offset.min()), float(offset.max())

    def field(self, z: Float[Tensor, " depths"]) -> Float[Tensor, "depths 2 3"]:
        """(q_x, q_y - along, q_z), mm, of the first and the last column of the left image at depths, mm."""
        slope = slope_at(self.rig, z.new_tensor([0.0, self.rig.width_px - 1.0]))
        x = slope * z[:, None]
        return to_product(torch.stack([x, torch.zeros_like(x), z[:, None].expand_as(x)], dim=-1), self.n)

    def shifted_column(
        self, column: Float[Tensor, "*batch"], relief: Float[Tensor, "*batch"], shift_mm: Float[Tensor, ""]
    ) -> Float[Tensor, "*batch"]:
        """Column in which a sensor line that looks at the plane Y = shift sees what the scan plane shows in another.

        The point is seen when the object has moved on by shift / n2 of travel, displaced by shift (n1, n3) / n2.
        """
        z = self.depth(column, relief)
        x_px = (column - self.rig.principal_left_px) * z + focal_length_px(self.rig) * shift_mm * self.n[0] / self.n[1]
        return self.rig.principal_left_px + x_px / (z + shift_mm * self.n[2] / self.n[1])

    def shifted_line(
        self, line: Float[Tensor, "*#batch"], shift_mm: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Line on which a sensor line that looks at the plane Y = shift sees what the scan plane shows on another."""
        return line_at(self.travel, travel_at(self.travel, line) - shift_mm / self.n[1])
