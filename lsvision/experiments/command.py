"""A command: compose the configuration, turn it into dataclasses once, run one experiment."""

import logging
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lsvision.errors import ConfigError, LsvisionError
from lsvision.experiments import EXPERIMENTS
from lsvision.experiments.command_line import EXPECTED, in_one_line, print_any_letter, quoted
from lsvision.experiments.hydra_hooks import register_settings
from lsvision.interruption import was_interrupted

log = logging.getLogger("lsvision")

register_settings()


def config_folder() -> Path:
    """The configs shipped with the package, or those of the checkout it runs from."""
    package = Path(__file__).parents[1]
    shipped = package / "_configs"
    return shipped if shipped.is_dir() else package.parent / "configs"


def _run(config: DictConfig) -> None:
    if config.name not in EXPERIMENTS:
        raise ConfigError(f"no experiment chosen: add +experiment=NAME with NAME one of {', '.join(EXPERIMENTS)}")
    import torch  # here, so that --help does not wait for it

    from lsvision.experiments.settings import build_settings

    experiment = EXPERIMENTS[config.name]
    try:
        values = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    settings = build_settings(experiment.schema, values)
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # damaged files are reported once, by our own error
    torch.manual_seed(settings.seed)
    torch.set_num_threads(settings.threads)
    experiment.run(settings, Path(HydraConfig.get().runtime.output_dir))


@hydra.main(version_base="1.3", config_path=str(config_folder()), config_name="config")
def _job(config: DictConfig) -> None:
    """Run the experiment that the configuration names; the trace of a failure goes to the run's log.

    A job of a sweep records its failure instead, and the others go on.
    """
    hydra_config = HydraConfig.get()
    if hydra_config.mode == RunMode.MULTIRUN:
        from lsvision.experiments.sweep import run_job

        folder = Path(hydra_config.runtime.output_dir)
        failure = run_job(partial(_run, config), folder, list(hydra_config.overrides.task))
        if failure is not None:
            _log_trace_to_file(failure)
        return
    try:
        _run(config)
    except EXPECTED as error:
        _log_trace_to_file(error)
        raise SystemExit(_report(error)) from None


def run_command() -> None:
    """Compose the configuration and run; an expected failure is one line and its exit code."""
    print_any_letter()
    known, sys.argv = sys.argv, [sys.argv[0]]
    own_handling = os.environ.get("HYDRA_FULL_ERROR")
    logging.raiseExceptions = False  # a log that cannot be written, on a full disk, must not bury the error
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's errors come here instead of being printed with its search paths
    try:
        sys.argv += quoted(known[1:])
        _job()
    except EXPECTED as error:
        raise SystemExit(_report(error)) from None
    finally:
        sys.argv, logging.raiseExceptions = known, True
        if own_handling is None:
            del os.environ["HYDRA_FULL_ERROR"]


def _report(error: BaseException) -> int:
    if was_interrupted():
        raise KeyboardInterrupt from None
    print(f"error: {in_one_line(error)}", file=sys.stderr)
    return error.exit_code if isinstance(error, LsvisionError) else 1


def _log_trace_to_file(error: Exception) -> None:
    """Write an exception's trace to the run's log file, past the console."""
    trace = (type(error), error, error.__traceback__)
    record = logging.LogRecord("lsvision", logging.ERROR, __file__, 0, "failed", None, trace)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.handle(record)
