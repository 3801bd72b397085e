"""Figures: each has a title, a caption and axes with units, and shows the values it is made from."""

import pytest
import torch
from mpl_toolkits.mplot3d import Axes3D

from lsvision.report.calibration_figures import (
    BoardView,
    components_by_iteration,
    corner_positions,
    corners_in_board_frame,
    corners_on_images,
    observability_bars,
    rmse_by_iteration,
    stretch_by_iteration,
)
from lsvision.report.drawing import new_figure, show_image, thinned
from lsvision.report.embedding import embed
from lsvision.report.line_motion_figures import (
    LineMotionView,
    Profiles,
    line_motion_figures,
    motion_by_line,
    motion_spectrum,
    profiles_before_and_after,
)
from lsvision.report.product_figures import SheetView, height_profile, product_images, sheet_correspondences
from lsvision.report.space_figures import corners_in_space, surface_in_space

# Counts and directions have no unit.
UNITLESS = ("iteration", "direction of n")


@pytest.fixture
def figures(determined, dominated, corners):
    curves = {"joint": determined, "two-step": dominated}
    truth = {"joint": (-0.026, 1.02, 0.014)}
    image, points = torch.randint(0, 256, (60, 80, 3)).to(torch.uint8), 50 * torch.rand(20, 2)
    height = torch.rand(60, 80)
    height[:10] = torch.nan
    moved = points + 0.1 * torch.randn(20, 2)
    return [
        rmse_by_iteration(curves, {"paper": 0.8794}),
        components_by_iteration(curves, truth),
        stretch_by_iteration(curves, 1.0204),
        observability_bars(determined),
        observability_bars(dominated, name="other", label="two-step"),
        corner_positions(corners, determined, label="first"),
        corners_on_images(BoardView(image, points), BoardView(image, points), 0.07),
        product_images("product", "Colour and height", image, height, 0.5, (10.0, -20.0)),
        height_profile("profile", "Profile", height, 0.5, -20.0),
        corners_in_space([corners, corners], determined),
        surface_in_space("surface", height, 0.5, (10.0, -20.0)),
        surface_in_space("nothing", torch.full((4, 5), torch.nan), 0.5, (10.0, -20.0)),
        sheet_correspondences(SheetView(image, points, moved), SheetView(image, points, points), 0.5),
        *line_motion_figures(LineMotionView(torch.rand(300, 4), torch.rand(300, 4), 0.5, (20.0, 80.0))),
        profiles_before_and_after(*(Profiles(torch.arange(40.0), torch.rand(9, 40)) for _ in range(2))),
    ]


def test_every_figure_has_a_title_a_caption_and_units(figures):
    assert len({figure.name for figure in figures}) == len(figures)
    for item in figures:
        assert item.title
        assert len(item.caption) > 30
        assert item.caption.endswith(".") or "tilt the board" in item.caption or "determined" in item.caption
        for axes in item.figure.axes:
            if axes.get_label() == "<colorbar>":
                assert "[" in axes.get_ylabel()
                continue
            assert axes.get_title()
            shares_y = bool(axes.get_shared_y_axes().get_siblings(axes)[1:])
            solid = [axes.get_zlabel()] if isinstance(axes, Axes3D) else []
            for label in (axes.get_xlabel(), axes.get_ylabel(), *solid):
                unit = "[" in label and "]" in label
                assert unit or label.startswith(UNITLESS) or (label == "" and shares_y), (item.name, label)


def test_curves_show_the_iterations(determined):
    (axes,) = rmse_by_iteration({"joint": determined}).figure.axes
    assert axes.lines[0].get_ydata().tolist() == [2.0, 0.5]
    panels = components_by_iteration({"joint": determined}).figure.axes
    assert [panel.lines[0].get_ydata().tolist() for panel in panels] == [[0.0, -0.026], [1.0, 1.02], [0.0, 0.014]]


def test_corners_in_the_board_frame_undo_motion_and_pose(corners):
    # The board ran 1.02 mm for each nominal one: with that n it fits, with the nominal one it is too short.
    n = torch.tensor([0.0, 1.02, 0.0], dtype=torch.float64)
    torch.testing.assert_close(corners_in_board_frame(corners, n), corners.board_points, rtol=0, atol=1e-9)
    nominal = corners_in_board_frame(corners, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    extent = nominal.amax(0) - nominal.amin(0)
    torch.testing.assert_close(extent[:2], torch.tensor([60 / 1.02, 60.0], dtype=torch.float64), rtol=0, atol=1e-9)


def test_product_axes_are_in_its_frame():
    height = torch.arange(12.0).reshape(3, 4)
    color = torch.zeros(3, 4, 3, dtype=torch.uint8)
    figure = product_images("p", "t", color, height, 0.5, (10.0, -20.0)).figure
    assert figure.axes[0].images[0].get_extent() == pytest.approx([-20.25, -18.25, 11.25, 9.75])
    empty = product_images("p", "t", color, torch.full((3, 4), torch.nan), 0.5, (0.0, 0.0))
    assert empty.figure.axes[1].images


def test_profile_is_the_median_of_the_rows():
    height = torch.tensor([[1.0, 2.0], [3.0, torch.nan], [50.0, 4.0]])
    (axes,) = height_profile("p", "t", height, 0.5, 7.0).figure.axes
    assert axes.lines[0].get_xdata().tolist() == [7.0, 7.5]
    assert axes.lines[0].get_ydata().tolist() == [3.0, 3.0]


def test_previews_are_thin_and_eight_bit():
    assert thinned(torch.zeros(5000, 700, 3), most=1000).shape == (1000, 140, 3)
    assert thinned(torch.zeros(30, 20)).shape == (30, 20)
    _, (axes,) = new_figure(2, 2)
    image = torch.tensor([[[65535], [256]]]).to(torch.uint16)
    shown = show_image(axes, image, (0, 2, 1, 0))
    assert shown.get_array().tolist() == [[255, 1]]


def test_surface_lies_where_its_cells_are():
    height = torch.arange(12.0).reshape(3, 4)
    axes = surface_in_space("s", height, 0.5, (10.0, -20.0)).figure.axes[0]
    assert axes.xy_dataLim.min.tolist() == [-20.0, 10.0]
    assert axes.xy_dataLim.max.tolist() == [-18.5, 11.0]
    assert axes.zz_dataLim.intervalx.tolist() == [0.0, 11.0]


def test_boards_stand_upright_and_fit(corners, determined):
    # A board 797 mm before the cameras lies at -797 in the figure, whose third axis points towards them.
    axes = corners_in_space([corners, corners], determined).figure.axes[0]
    heights = axes.collections[0]._offsets3d[2]
    assert heights == pytest.approx(-(797.0 + 0.014 * corners.points[:, 1].numpy()))


def test_embedded_as_vector_pixels_or_views(tmp_path, figures):
    by_name = {item.name: item.figure for item in figures}
    drawing = embed(by_name["rmse_by_iteration"], tmp_path / "drawing")
    assert drawing.vector
    assert drawing.uris[0].startswith("data:image/svg+xml;base64,")
    picture = embed(by_name["product"], tmp_path / "picture")
    assert not picture.vector
    assert picture.uris[0].startswith("data:image/png;base64,")
    solid = embed(by_name["surface"], tmp_path / "solid")
    assert len(set(solid.uris)) == len(solid.uris) == 18
    assert all(uri.startswith("data:image/webp;base64,") for uri in solid.uris)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"{name}.{kind}" for name in ("drawing", "picture", "solid") for kind in ("png", "svg")
    ]


def shaken(lines: int) -> LineMotionView:
    """A sine of 0.3 mm over 25 mm in depth and one of 2 mrad over 40 mm in roll, on lines 0.5 mm apart."""
    along = 0.5 * torch.arange(lines).double()
    values, sigma = torch.zeros(lines, 4).double(), torch.full((lines, 4), 0.01).double()
    values[:, 1] = 0.3 * torch.sin(2 * torch.pi * along / 25)
    values[:, 2] = 2e-3 * torch.sin(2 * torch.pi * along / 40)
    return LineMotionView(values, sigma, 0.5)


def test_only_what_moves_is_drawn_and_roll_in_degrees():
    depth, roll = motion_by_line(shaken(400)).figure.axes
    assert depth.get_ylabel() == "displacement [mm]"
    assert roll.get_ylabel() == "displacement [deg]"
    line, band = roll.lines[0], roll.collections[0].get_paths()[0].vertices[:, 1]
    assert max(line.get_ydata()) == pytest.approx(0.1146, rel=1e-3)
    assert band.max() == pytest.approx(0.1146 + 2 * 0.573, rel=1e-3)
    assert line_motion_figures(LineMotionView(torch.zeros(9, 4), torch.zeros(9, 4), 0.5)) == []


def test_a_long_scan_shows_its_beginning_and_says_so():
    figure = motion_by_line(shaken(5000))
    assert len(figure.figure.axes[0].lines[0].get_xdata()) == 4000
    assert "The first 4000 of 5000 lines" in figure.caption


def test_a_spectrum_peaks_at_amplitude_and_wavelength():
    figure = motion_spectrum(shaken(4000))
    for axes, wavelength, amplitude in zip(figure.figure.axes, (25.0, 40.0), (0.3, 0.1146), strict=True):
        x, y = axes.lines[0].get_data()
        assert max(y) == pytest.approx(amplitude, rel=0.01)
        assert x[y.argmax()] == pytest.approx(wavelength, rel=0.01)
    assert "corrugation" not in figure.caption
