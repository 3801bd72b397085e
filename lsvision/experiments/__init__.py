"""The experiments a run can choose: each reads, calls stages, and writes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lsvision.experiments.calibrate import CalibrateSettings, run_calibrate
from lsvision.experiments.correct import CorrectSettings, run_correct
from lsvision.experiments.paper import PaperSettings, run_paper
from lsvision.experiments.reprocess import ReprocessSettings, StatusSettings, run_reprocess, run_status
from lsvision.experiments.settings import RunSettings
from lsvision.experiments.simulate import SimulateSettings, run_simulate
from lsvision.experiments.study import StudySettings, run_study
from lsvision.experiments.sweep import CollectSettings, run_collect
from lsvision.experiments.validate import ValidateSettings, run_validate

# By name: the function and the schema of its options.
EXPERIMENTS: dict[str, tuple[Callable[[Any, Path], None], type[RunSettings]]] = {
    "paper": (run_paper, PaperSettings),
    "simulate": (run_simulate, SimulateSettings),
    "calibrate": (run_calibrate, CalibrateSettings),
    "correct": (run_correct, CorrectSettings),
    "reprocess": (run_reprocess, ReprocessSettings),
    "status": (run_status, StatusSettings),
    "validate": (run_validate, ValidateSettings),
    "study": (run_study, StudySettings),
    "collect": (run_collect, CollectSettings),
}
