"""Registration of single lines, and the errors that its residuals show, on exact depth of a rendered rail."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from lsvision.geometry import ProductFrame, object_pitch_mm
from lsvision.simulation import SceneConfig
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.errors import ErrorSums, LineErrors
from lsvision.stages.line_motion.profiles import LineSamples, Reference, columns_of, reference_profile
from lsvision.stages.line_motion.register import Registered, equations_of, placed, register
from lsvision.types import Depth
from tests.stages.line_motion.test_measure import RIG, SHAKEN, SIGMA_MM, STILL, matched, rendered

CONFIG = LineMotionConfig()
FLAWLESS = SceneConfig(kind="rail", defect_spacing_mm=0.0, roll_mark_period_mm=0.0)


def frame() -> ProductFrame:
    source, _ = rendered(STILL, FLAWLESS)
    return ProductFrame(RIG, source.travel, source.trajectory.n)


def samples_of(depth: Tensor) -> LineSamples:
    return LineSamples.of(Depth(depth, torch.full_like(depth, SIGMA_MM)), frame(), (-60.0, 60.0), slice(None))


def reference() -> tuple[Reference, slice]:
    """The rail at rest, and the columns that show it."""
    still = samples_of(rendered(STILL, FLAWLESS)[1][::4])
    q_x, height = placed(still, torch.zeros(len(still.z), 3).double(), frame())
    found = reference_profile(q_x, height, object_pitch_mm(RIG), 40.0)
    return found, columns_of(found, q_x, 10_000)


def test_exact_lines_come_back_to_their_displacement() -> None:
    source, depth = rendered(SHAKEN, FLAWLESS)
    profile, columns = reference()
    found = register(samples_of(depth).on(columns), torch.zeros(len(depth), 3).double(), profile, frame(), CONFIG)
    truth = source.trajectory.vibration(torch.arange(len(depth)).double())
    error = (found.values - truth).square().mean(0).sqrt()
    assert error[0] < 0.005  # nodes 0.28 mm apart cut the gauge corner
    assert error[1] < 0.0005
    assert error[2] < math.radians(0.005)


def test_batch_equals_loop() -> None:
    profile, columns = reference()
    lines, start = samples_of(matched(rendered(SHAKEN, FLAWLESS)[1][:5])).on(columns), torch.zeros(5, 3).double()
    whole = register(lines, start, profile, frame(), CONFIG)
    one = dataclasses.replace(lines, z=lines.z[2:3], sigma=lines.sigma[2:3])
    alone = register(one, start[:1], profile, frame(), CONFIG)
    for part in dataclasses.fields(Registered):
        torch.testing.assert_close(getattr(alone, part.name)[0], getattr(whole, part.name)[2], rtol=1e-9, atol=1e-12)
    twice = Registered.joined([alone, alone])
    assert torch.equal(twice.values[0], twice.values[1])
    kept = Registered.nothing(4)
    kept.put(2, alone)
    assert torch.equal(kept.values[2], alone.values[0])
    assert not kept.information[[0, 1, 3]].any()


def test_information_is_that_of_independent_samples() -> None:
    profile, columns = reference()
    depth = rendered(STILL, FLAWLESS)[1]
    generator = torch.Generator().manual_seed(3)
    noisy = samples_of(depth + SIGMA_MM * torch.randn(depth.shape, generator=generator)).on(columns)
    found = register(noisy, torch.zeros(len(depth), 3).double(), profile, frame(), CONFIG)
    stated = torch.linalg.inv(found.information).diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    torch.testing.assert_close(found.values.std(0), stated, rtol=0.25, atol=0)
    halves = (found.difference.square().mean(0) / found.difference_variance.mean(0)).sqrt()
    assert ((halves > 0.7) & (halves < 1.3)).all()


def sums_of(lines: LineSamples, at: Tensor) -> ErrorSums:
    equations = equations_of(lines, at, reference()[0], frame())
    return ErrorSums.of(equations, CONFIG.cut_sigma)


def test_errors_of_neighbours_show_in_what_the_registration_leaves() -> None:
    """A window of 9 px and lines makes errors up to three times as large, and remembers them for 4.5 lines."""
    profile, columns = reference()
    lines = samples_of(matched(rendered(STILL, FLAWLESS)[1])).on(columns)
    found = register(lines, torch.zeros(len(lines.z), 3).double(), profile, frame(), CONFIG)
    errors, common = (LineErrors.of(sums_of(lines, found.values), common_mm) for common_mm in (0.0, 0.5))
    assert ((errors.scale > 2.0) & (errors.scale < 3.4)).all()
    assert ((errors.memory > 3.5) & (errors.memory < 5.5)).all()
    torch.testing.assert_close(errors.rms, found.values.std(0), rtol=0.25, atol=0)
    assert float(common.rms[1]) == pytest.approx(math.hypot(0.5, float(errors.rms[1])))
    assert torch.equal(common.rms[[0, 2]], errors.rms[[0, 2]])


def test_errors_of_independent_samples_are_as_stated() -> None:
    profile, columns = reference()
    depth = rendered(STILL, FLAWLESS)[1]
    generator = torch.Generator().manual_seed(3)
    lines = samples_of(depth + SIGMA_MM * torch.randn(depth.shape, generator=generator)).on(columns)
    found = register(lines, torch.zeros(len(depth), 3).double(), profile, frame(), CONFIG)
    errors = LineErrors.of(sums_of(lines, found.values), 0.0)
    torch.testing.assert_close(errors.scale, torch.ones(3).double(), rtol=0.15, atol=0)
    assert (errors.memory < 0.7).all()


def test_sums_of_parts_are_those_of_all_lines() -> None:
    profile, columns = reference()
    lines = samples_of(matched(rendered(SHAKEN, FLAWLESS)[1])).on(columns)
    found = register(lines, torch.zeros(len(lines.z), 3).double(), profile, frame(), CONFIG)
    whole = sums_of(lines, found.values)
    total = ErrorSums.total([sums_of(*part) for part in zip(lines.split(150), found.values.split(150), strict=True)])
    for name in ("products", "pairs", "sensitivity"):
        torch.testing.assert_close(getattr(total, name), getattr(whole, name))
    torch.testing.assert_close(total.lasting[0], whole.lasting[0])
    assert total.lasting_pairs[50].sum() < whole.lasting_pairs[50].sum()


def test_reference_of_nothing() -> None:
    nothing = torch.full((4, 6), torch.nan).double()
    assert reference_profile(nothing, nothing, 1.0, 40.0) is None
    scattered = torch.where(torch.eye(4, 6) > 0, 1.0, torch.nan).double()
    assert reference_profile(10 * torch.arange(6).double().expand(4, 6), scattered, 1.0, 40.0) is None


def test_reference_is_the_median_down_to_a_depth() -> None:
    q_x = torch.arange(40).double().expand(9, -1)
    height = (20.0 - (q_x - 20.0).abs()).clone()
    height[3] += 5.0  # one line that does not belong
    height[:, :2] = torch.nan
    found = reference_profile(q_x, height, 1.0, 10.0)
    level, slope = found.at(torch.tensor([15.5, 25.0, 3.0]).double())
    torch.testing.assert_close(level[:2], torch.tensor([15.5, 15.0]).double())
    torch.testing.assert_close(slope[:2], torch.tensor([1.0, -1.0]).double())
    assert level[2].isnan()
    assert columns_of(found, q_x, 5) == slice(12, 29, 4)
