"""The product frame M: the one place that knows where what a scan saw lies in its product.

The axes follow the motion n: e_y = n / ‖n‖, e_z = the viewing direction Z made orthogonal to e_y, e_x = e_y x e_z. What
column u sees at depth z on line v lies at

    q = z ray(u) + along(v) e_y,        ray(u) = slope(u) X + Z in the product's axes,   along(v) = ‖n‖ travel(v).

So q_x and q_z of a sample depend on its own line alone and do not grow with the line number: a scan of any length stays
in frame and is worked on strip by strip. With a the rows e_x, e_y, e_z, q_y of a sample follows from the other two:

    q_y = along(v) - (a_01 q_x + a_21 q_z) / a_11.

Where the object moves from line to line besides (``line_motion``), what line v shows is turned and shifted back within
the line before anything else, x' + z' for x + z: q = z ray(u, v) + origin(v) + along(v) e_y. All the rest stays, as
q_x and q_z of a sample still depend on its own line alone.

Heights are counted towards the cameras from c = (B/2, 0, z0), the middle of the plane of zero disparity:
height = q_z(c) - q_z. Kernels in single precision carry the **relief** instead, z0 - q_z, which differs from the height
by a constant of the frame (``height_over_relief_mm``).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry.camera import focal_length_px, middle_point, object_pitch_mm, slope_at, zero_disparity_mm
from lsvision.geometry.line_motion import LineAxes, line_axes, shaken, steadied, steadied_jacobian, uneven_travel
from lsvision.geometry.motion import line_at, travel_at
from lsvision.geometry.product_axes import from_product, product_axes, to_product
from lsvision.types import LineMotion, Rig, Travel


@dataclass(frozen=True)
class ProductFrame:
    """The product frame of one scan: between (column, line, depth) of the left image and (q_x, q_y, q_z), mm.

    Attributes:
        rig: the cameras. travel: of the scan.
        n: motion of the object, mm per nominal mm of travel, float64.
        line_motion: motion from line to line; None for a still object, whose results it leaves as they are to the bit.
    """

    rig: Rig
    travel: Travel
    n: Float[Tensor, "3"]
    line_motion: LineMotion | None = None

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

    @cached_property
    def true_travel(self) -> Travel:
        """Travel of the lines with what the line motion adds to it."""
        return self.travel if self.line_motion is None else uneven_travel(self.travel, self.line_motion)

    def ray(self, column: Float[Tensor, "*#batch"], line: Tensor | None = None) -> Float[Tensor, "*batch 3"]:
        """Product coordinates of what a column of the left image sees, per mm of depth, less ``origin`` and ``along``.

        Args:
            line: (fractional) lines; None for a line at rest.
        """
        slope = slope_at(self.rig, column)[..., None]
        if self.line_motion is None or line is None:
            return slope * self.axes[:, 0] + self.axes[:, 2]
        lines = self.line_axes(line)
        return slope * lines.across + lines.ahead

    def line_axes(self, line: Float[Tensor, "*batch"]) -> LineAxes:
        """How (fractional) lines lie in the product; the same for all lines without line motion."""
        motion = self.axes.new_zeros(*line.shape, 4) if self.line_motion is None else self.line_motion.at(line)
        return line_axes(self.axes, motion.to(self.axes), middle_point(self.rig).to(self.axes))

    def along(self, line: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Distance, mm, that the object has moved along e_y at (fractional) lines."""
        return self.stretch * travel_at(self.true_travel, line)

    def line(self, along: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """(Fractional) line at which the object has moved a distance along e_y, mm: the inverse of ``along``."""
        return line_at(self.true_travel, along / self.stretch)

    def position(
        self, column: Float[Tensor, "*#batch"], line: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch 3"]:
        """(q_x, q_y, q_z), mm, of what a column of the left image sees at depth z, mm, on a line."""
        y_axis = self.n.new_tensor([0.0, 1.0, 0.0])
        q = z[..., None] * self.ray(column, line) + self.along(line)[..., None] * y_axis
        return q if self.line_motion is None else q + self.line_axes(line).origin

    def source(self, q: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """(column, line, z) of the left image that sees (q_x, q_y, q_z), mm: the inverse of ``position``."""
        x, y, z = from_product(q, self.n).unbind(-1)
        line = line_at(self.true_travel, y)
        x, z = self._shown(x, z, line)
        column = self.rig.principal_left_px + x / z * focal_length_px(self.rig)
        return torch.stack([column, line, z], dim=-1)

    def q_y(
        self, along: Float[Tensor, "*#batch"], q_x: Float[Tensor, "*#batch"], relief: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """q_y, mm, of a sample of a line at ``along``, from its place across the line and its relief, mm."""
        return along - self.lag(q_x) + relief * self.q_y_per_relief

    def lag(self, q_x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """How far q_y of the samples of a line falls behind its ``along``, mm, at relief zero."""
        by_q_x, by_q_z = self.axes[0, 1] / self.axes[1, 1], self.axes[2, 1] / self.axes[1, 1]
        return q_x * by_q_x + zero_disparity_mm(self.rig) * by_q_z

    def depth(
        self, column: Float[Tensor, "*#batch"], relief: Float[Tensor, "*#batch"], line: Tensor | None = None
    ) -> Float[Tensor, "*batch"]:
        """Depth z, mm, of what a column of the left image sees at a relief, mm.

        Args:
            line: (fractional) lines; None for a line at rest.
        """
        q_z = zero_disparity_mm(self.rig) - relief
        if self.line_motion is not None and line is not None:
            q_z = q_z - self.line_axes(line).origin[..., 2]
        return q_z / self.ray(column, line)[..., 2]

    def shown_on_lines(
        self, place: Float[Tensor, "*#batch 2"], motion: Float[Tensor, "*#batch 4"]
    ) -> Float[Tensor, "*batch 2"]:
        """(x, z), mm, in the scan frame, where lines of some motion show what lies at (q_x, q_z), mm."""
        still = torch.linalg.solve(self.axes[::2, ::2], place[..., None])[..., 0]
        return shaken(still, motion, middle_point(self.rig).to(still))

    def offset_range(self, q_x: Float[Tensor, " places"], z: Float[Tensor, " depths"]) -> tuple[float, float]:
        """Least and greatest q_y, mm, less ``along``, of samples at places across the line and at depths, mm."""
        if self.line_motion is not None:
            z = torch.cat([z - self._largest_rise_mm, z + self._largest_rise_mm])
        x = (q_x[:, None] - z * self.axes[0, 2]) / self.axes[0, 0]
        offset = x * self.axes[1, 0] + z * self.axes[1, 2]
        return float(offset.min()), float(offset.max())

    def field(self, z: Float[Tensor, " depths"]) -> Float[Tensor, "depths 2 3"]:
        """(q_x, q_y - along, q_z), mm, of the first and the last column at depths, mm, of a line at rest."""
        slope = slope_at(self.rig, z.new_tensor([0.0, self.rig.width_px - 1.0]))
        x = slope * z[:, None]
        return to_product(torch.stack([x, torch.zeros_like(x), z[:, None].expand_as(x)], dim=-1), self.n)

    def plane_y(self, shift_mm: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
        """Y, mm, at which a sensor line that looks at Y = shift at z0 sees a point that the scan plane shows at z, mm.

        Its plane goes through the cameras' centres, Y = shift z / z0: the further away, the further apart the lines
        look. Until it sees the point, the object has moved in depth by Y n3 / n2.
        """
        return shift_mm * z / (zero_disparity_mm(self.rig) - shift_mm * self.n[2] / self.n[1])

    def shifted_column(
        self,
        column: Float[Tensor, "*batch"],
        z: Float[Tensor, "*batch"],
        shift_mm: Float[Tensor, "*#batch"],
        lines: tuple[Tensor, Tensor] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Column in which a sensor line sees at Y = shift what the scan plane shows in another column at depth z, mm.

        The point is seen when the object has moved on by shift / n2 of travel, displaced by shift (n1, n3) / n2.

        Args:
            shift_mm: ``plane_y`` of the point.
            lines: the (fractional) line that shows the point in ``column``, and the one on which the sensor line sees
                it, ``shifted_line``; None without line motion.
        """
        moved_x, moved_z = shift_mm * self.n[0] / self.n[1], shift_mm * self.n[2] / self.n[1]
        if self.line_motion is None or lines is None:
            x_px = (column - self.rig.principal_left_px) * z + focal_length_px(self.rig) * moved_x
            return self.rig.principal_left_px + x_px / (z + moved_z)
        seen = torch.stack([slope_at(self.rig, column) * z, z], dim=-1)
        still = steadied(seen, self.line_motion.at(lines[0]), middle_point(self.rig).to(seen))
        x, z = self._shown(still[..., 0] + moved_x, still[..., 1] + moved_z, lines[1])
        return self.rig.principal_left_px + x / z * focal_length_px(self.rig)

    def shifted_line(
        self, line: Float[Tensor, "*#batch"], shift_mm: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch"]:
        """Line on which a sensor line sees at Y = shift, its ``plane_y``, what the scan plane shows on another line."""
        return line_at(self.true_travel, travel_at(self.true_travel, line) - shift_mm / self.n[1])

    def displacement_jacobian(
        self, column: Float[Tensor, "*batch"], line: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch 3 4"]:
        """Derivative of ``position`` by the line motion (δx, δz, roll, δy) of the line.

        Raises:
            ValueError: the frame has no line motion.
        """
        if self.line_motion is None:
            raise ValueError("the frame must have a line_motion, has None")
        motion, pivot = self.line_motion.at(line), middle_point(self.rig).to(z)
        seen = torch.stack([slope_at(self.rig, column) * z, z], dim=-1)
        within = steadied_jacobian(steadied(seen, motion, pivot), motion, pivot)
        by_x, by_z = self.axes[:, 0, None], self.axes[:, 2, None]
        along = (self.stretch * self.n.new_tensor([0.0, 1.0, 0.0])).expand(*z.shape, 3)
        return torch.cat([by_x * within[..., :1, :] + by_z * within[..., 1:, :], along[..., None]], dim=-1)

    def _shown(self, x: Tensor, z: Tensor, line: Tensor) -> tuple[Tensor, Tensor]:
        """(x, z) in the scan frame of what a still object would have shown at (x, z) on a line."""
        if self.line_motion is None:
            return x, z
        still = torch.stack([x, z], dim=-1)
        seen = shaken(still, self.line_motion.at(line), middle_point(self.rig).to(still))
        return seen[..., 0], seen[..., 1]

    @cached_property
    def _largest_rise_mm(self) -> float:
        """How far the line motion moves any sample of the field in depth, at most."""
        motion, half_field = self.line_motion, self.rig.width_px * object_pitch_mm(self.rig)
        return 0.0 if motion is None else float((motion.dz_mm.abs() + half_field * motion.roll_rad.abs()).max())
