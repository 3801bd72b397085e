"""The experiments a run can choose: each reads, calls stages, and writes. One is imported when it is chosen."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lsvision.experiments.settings import RunSettings


@dataclass(frozen=True)
class Experiment:
    """Where an experiment stands: its module here, its function and the dataclass of its options."""

    module: str
    function: str
    settings: str

    @property
    def run(self) -> Callable[[Any, Path], None]:
        """The function; takes the settings and the run's folder."""
        run: Callable[[Any, Path], None] = getattr(self._imported, self.function)
        return run

    @property
    def schema(self) -> type["RunSettings"]:
        """The dataclass of the options, with their defaults and ranges."""
        schema: type[RunSettings] = getattr(self._imported, self.settings)
        return schema

    @property
    def _imported(self) -> object:
        return import_module(f"{__name__}.{self.module}")


EXPERIMENTS = {
    "paper": Experiment("paper", "run_paper", "PaperSettings"),
    "simulate": Experiment("simulate", "run_simulate", "SimulateSettings"),
    "calibrate": Experiment("calibrate", "run_calibrate", "CalibrateSettings"),
    "rig": Experiment("rig", "run_rig", "RigSettings"),
    "response": Experiment("response", "run_response", "ResponseSettings"),
    "correct": Experiment("correct", "run_correct", "CorrectSettings"),
    "motion": Experiment("motion", "run_motion", "MotionSettings"),
    "inspect": Experiment("inspect", "run_inspect", "InspectSettings"),
    "view": Experiment("view", "run_view", "ViewSettings"),
    "reprocess": Experiment("reprocess", "run_reprocess", "ReprocessSettings"),
    "status": Experiment("reprocess", "run_status", "StatusSettings"),
    "validate": Experiment("validate", "run_validate", "ValidateSettings"),
    "study": Experiment("study", "run_study", "StudySettings"),
    "study_rig": Experiment("study_rig", "run_study_rig", "StudyRigSettings"),
    "collect": Experiment("sweep", "run_collect", "CollectSettings"),
}
