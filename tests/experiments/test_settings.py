import functools
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_type_hints

import pytest
from annotated_types import Ge, Gt, Le, Lt, MinLen
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from pydantic import AllowInfNan

from lsvision.errors import ConfigError
from lsvision.experiments import EXPERIMENTS
from lsvision.experiments.command import config_folder
from lsvision.experiments.settings import RunSettings, build_settings, settings_sha256
from lsvision.schema import Checked, Seed, shape_of
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.types import CalibrationMethod

CALIBRATION_METHODS = shape_of(CalibrationMethod).arguments


@dataclass(frozen=True)
class Inner(Checked):
    kind: Literal["near", "far"] = "near"
    span: tuple[float, float] = (0.0, 1.0)
    pitch: float | None = None


@dataclass(frozen=True, kw_only=True)
class Outer(RunSettings):
    inner: Inner
    scans: list[str]


GOOD = {"name": "outer", "inner": {"kind": "far", "span": [1, 2.5], "pitch": None}, "scans": ["a"]}


def test_values_become_dataclasses_with_tuples_and_defaults():
    assert build_settings(Outer, GOOD) == Outer(name="outer", inner=Inner("far", (1, 2.5), None), scans=["a"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner": {"kind": "nigh"}}, r"inner\.kind: expected 'near' or 'far', got 'nigh'"),
        ({"inner": {"knd": "near"}}, r"inner\.knd: unknown key; did you mean 'kind'\?"),
        ({"inner": {"pitch": "wide"}}, r"inner\.pitch: expected a finite number, got 'wide'"),
        ({"scans": "a"}, r"scans: expected"),
        ({"spam": 1}, r"spam: unknown key; known keys: name, seed, threads, inner, scans"),
    ],
)
def test_a_wrong_option_is_named(change, message):
    with pytest.raises(ConfigError, match=message):
        build_settings(Outer, {**GOOD, **change})


def test_a_missing_option_is_named():
    with pytest.raises(ConfigError, match="scans: missing"):
        build_settings(Outer, {"name": "outer", "inner": {}})


def test_hash_follows_every_value():
    one = build_settings(Outer, GOOD)
    other = build_settings(Outer, {**GOOD, "inner": {"kind": "far", "span": [1, 2.5000001]}})
    assert settings_sha256(one) == settings_sha256(build_settings(Outer, GOOD)) != settings_sha256(other)


@functools.cache
def composed(experiment: str, *overrides: str) -> dict[str, Any]:
    """Plain options of a run as the command line composes them, with a text for every one that is missing."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose("config", [f"+experiment={experiment}", *overrides])
    for key in OmegaConf.missing_keys(config):
        OmegaConf.update(config, key, "somewhere")
    return OmegaConf.to_container(config, resolve=True)


def options(annotation: Any, value: Any, path: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Path and annotation of every option below one, down to the elements of lists and mappings that are there."""
    shape = shape_of(annotation)
    if path:
        yield path, annotation
    if shape.is_dataclass and value is not None:
        for name, hint in get_type_hints(shape.kind, include_extras=True).items():
            yield from options(hint, value[name], (*path, name))
    elif shape.kind in (list, tuple) and value:
        yield from options(shape.item(0), value[0], (*path, 0))
    elif shape.kind is dict and value:
        name = next(iter(value))
        yield from options(shape.arguments[1], value[name], (*path, name))


def wrong_values(annotation: Any) -> Iterator[object]:
    """Values that an option must not take: out of range by its own bounds, not finite, of another type."""
    shape = shape_of(annotation)
    if not shape.optional:
        yield None
    if shape.is_dataclass:
        yield from ("text", 3, True, [], {"no_such_option": 1})
    elif shape.kind in (int, float):
        yield from ("3", "three", True, [3], {}, math.nan, -math.inf)
        yield from () if AllowInfNan(True) in shape.metadata else (math.inf,)
        yield from (1.5, 3.0) if shape.kind is int else (10**400,)
        for bound in shape.metadata:
            yield from (bound.gt, bound.gt - 1) if isinstance(bound, Gt) else ()
            yield from (bound.ge - 1,) if isinstance(bound, Ge) else ()
            yield from (bound.lt, bound.lt + 1) if isinstance(bound, Lt) else ()
            yield from (bound.le + 1,) if isinstance(bound, Le) else ()
    elif shape.kind is bool:
        yield from (0, 1, "yes", "true", 1.0, [])
    elif shape.kind is str:
        yield from (3, 1.5, True, math.nan, [], *([""] if MinLen(1) in shape.metadata else []))
    elif shape.kind is Literal:
        yield from ("no such choice", 3, True, math.nan, [])
    elif shape.kind in (list, tuple):
        yield from ("text", 3, True, math.nan, {}, [None], [[]])
        yield from ([],) if MinLen(1) in shape.metadata else ()
        yield from ([1.0], [1.0, 2.0, 3.0, 4.0]) if shape.fixed_length else ()
    elif shape.kind is dict:
        yield from ("text", 3, True, [], {"a": 3}, {"a": "text"})
    else:
        assert shape.kind is Union, annotation
        yield from (True, math.nan, [], {})


def dotted(path: tuple) -> str:
    """The name by which an error calls an option."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_option_of_every_experiment_refuses_what_it_cannot_be(name):
    schema = EXPERIMENTS[name].schema
    complete = asdict(build_settings(schema, composed(name)))
    values, tried = OmegaConf.to_container(OmegaConf.create(complete)), 0
    for path, annotation in options(schema, complete):
        for value in wrong_values(annotation):
            holder: Any = values
            for part in path[:-1]:
                holder = holder[part]
            before, holder[path[-1]] = holder[path[-1]], value
            with pytest.raises(ConfigError) as raised:
                build_settings(schema, values)
            holder[path[-1]] = before
            message = str(raised.value)
            assert message.startswith(dotted(path)), (path, value)
            assert "\n" not in message
            assert any(problem in message for problem in (": expected ", ": unknown key", ": missing")), (path, value)
            tried += 1
    assert tried > 20


@pytest.mark.parametrize(
    ("experiment", "changes", "message"),
    [
        ("correct", {"correction.strip_rows": 0}, "correction.strip_rows: expected a whole number >= 1, got 0"),
        ("correct", {"correction.bridge_px": -3}, "correction.bridge_px: expected a whole number >= 0, got -3"),
        ("correct", {"threads": 0}, "threads: expected a whole number >= 1, got 0"),
        ("correct", {"seed": -1}, "seed: expected a whole number >= 0 and < 4294967296, got -1"),
        ("correct", {"export": ["obj"]}, "export[0]: expected 'tiff', 'ply' or 'laz', got 'obj'"),
        (
            *("correct", {"correction.height_range_mm": [60, -60]}),
            "correction.height_range_mm: expected a list of two finite numbers, the lower one first, got [60, -60]",
        ),
        ("correct", {"disparity.block_size": -5}, "disparity.block_size: expected an odd whole number >= 1, got -5"),
        (
            "correct",
            {"disparity.refine_window": 0},
            "disparity.refine_window: expected an odd whole number >= 3, got 0",
        ),
        ("reprocess", {"engine.workers": 0}, "engine.workers: expected a whole number >= 1, got 0"),
        ("reprocess", {"engine.workers": -1}, "engine.workers: expected a whole number >= 1, got -1"),
        ("simulate", {"sensor.bits": 12}, "sensor.bits: expected 8 or 16, got 12"),
        (
            *("simulate", {"scene.kind": "rail"}),
            "scene.pitch_deg: expected 0, as a rail runs along the motion, got 2.0",
        ),
        (
            *("calibrate", {"calibration.method": "two_step", "calibration.mounting_pitch_deg": 2}),
            "calibration.mounting_pitch_deg: expected null, as two_step cannot use it, got 2.0",
        ),
        ("simulate", {"rig.principal_right_px": 0}, "rig.principal_right_px: expected a finite number > 1042, got 0.0"),
        (
            *("study", {"conditions.corner_sigma_mm": 0}),
            "conditions.corner_sigma_mm: expected a finite number > 0, got 0",
        ),
    ],
)
def test_messages(experiment, changes, message):
    values = OmegaConf.create(composed(experiment))
    for key, value in changes.items():
        OmegaConf.update(values, key, value)
    with pytest.raises(ConfigError) as raised:
        build_settings(EXPERIMENTS[experiment].schema, OmegaConf.to_container(values))
    assert str(raised.value) == message


def test_a_seed_reaches_to_32_bits():
    assert shape_of(Seed).metadata == (Ge(0), Lt(2**32))
    assert build_settings(Outer, {**GOOD, "seed": 2**32 - 1}).seed == 2**32 - 1


# What each matcher sets, option by option.
RESOLVED = {
    ("auto", 7142): ("coarse_to_fine", 1, 0.2, 48),
    ("auto", 1499): ("sgbm", 2, 0.22, 48),
    ("sgbm", 7142): ("sgbm", 2, math.inf, 24),
    ("coarse_to_fine", 900): ("coarse_to_fine", 1, 0.2, 48),
}


@pytest.mark.parametrize(("matcher", "width"), RESOLVED)
def test_a_matcher_is_one_from_its_file_from_its_option_and_from_python(matcher, width):
    from_file = composed("correct", f"stages/disparity@disparity={matcher}")["disparity"]
    from_option = composed("correct", f"disparity.matcher={matcher}")["disparity"]
    config = DisparityConfig(matcher=matcher)
    assert DisparityConfig(**from_file) == DisparityConfig(**from_option) == config
    resolved = config.for_width(width)
    found = (resolved.matcher, resolved.refine_iterations, resolved.largest_sigma_px, resolved.halo_lines)
    assert found == RESOLVED[matcher, width]
    assert resolved.for_width(width) == resolved


def test_an_option_of_a_matcher_that_is_stated_wins():
    config = DisparityConfig(matcher="sgbm", refine_iterations=0, largest_sigma_px=0.1, halo_lines=5).for_width(4000)
    assert (config.refine_iterations, config.largest_sigma_px, config.halo_lines) == (0, 0.1, 5)


@pytest.mark.parametrize("method", CALIBRATION_METHODS)
def test_a_method_is_one_from_its_file_from_its_option_and_from_python(method):
    from_file = composed("calibrate", f"stages/calibration@calibration={method}")["calibration"]
    from_option = composed("calibrate", f"calibration.method={method}")["calibration"]
    config = CalibrationConfig(method=method)
    assert CalibrationConfig(**from_file) == CalibrationConfig(**from_option) == config
    assert config.resolved().process_sigma == (1e-6 if method == "sequential" else 0.0)


def test_files_of_a_stage_are_its_variants_and_defaults_are_the_dataclass():
    names = {
        path.relative_to(config_folder() / "stages").as_posix() for path in config_folder().glob("stages/*/*.yaml")
    }
    variants = {f"disparity/{matcher}.yaml" for matcher, _ in RESOLVED}
    variants |= {f"calibration/{method}.yaml" for method in CALIBRATION_METHODS}
    assert names == variants | {f"{stage}/default.yaml" for stage in ("corners", "correction", "line_motion")}
    assert CornersConfig(**composed("calibrate")["corners"]) == CornersConfig()
    assert CorrectionConfig(**composed("correct")["correction"]) == CorrectionConfig()
    assert LineMotionConfig(**composed("correct")["registration"]) == LineMotionConfig()
    narrow = composed("reprocess", "correction.height_range_mm=[-9,9]")["registration"]
    assert LineMotionConfig(**narrow) == LineMotionConfig(height_range_mm=(-9.0, 9.0))


def test_help_waits_for_no_library_of_the_experiments():
    heavy = ("torch", "cv2", "kornia", "matplotlib", "polars", "zarr", "tifffile", "pydantic")
    code = f"import sys, lsvision.run; print([name for name in {heavy} if name in sys.modules])"
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
