"""What Hydra calls: the defaults of all options as configuration nodes, and the hook at the end of a sweep."""

import itertools
import sys
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from lsvision.experiments import EXPERIMENTS

_GROUP = "settings/"


class SettingsSource(ConfigSource):
    """Every option of an experiment with its default, from its dataclass, as the configuration ``settings/NAME``.

    Plain values without types: what an option may be is checked once, by ``lsvision.schema``. The experiment's module
    is imported when its node is asked for.
    """

    @staticmethod
    def scheme() -> str:
        """What a search path starts with."""
        return "settings"

    def load_config(self, config_path: str) -> ConfigResult:
        """The node of an experiment, for the root of the configuration."""
        from lsvision.schema import default_values

        schema = EXPERIMENTS[_experiment_of(config_path)].schema
        node = OmegaConf.create(default_values(schema))
        return ConfigResult(self.provider, self.full_path(), node, header={"package": "_global_"})

    def available(self) -> bool:
        """Always."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Whether a path holds nodes."""
        return config_path.strip("/") == _GROUP.strip("/")

    def is_config(self, config_path: str) -> bool:
        """Whether a path is a node."""
        return config_path.startswith(_GROUP) and _experiment_of(config_path) in EXPERIMENTS

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Nothing: the nodes belong to the experiments and are not to be chosen from."""
        return []


class SettingsPath(SearchPathPlugin):
    """Puts ``SettingsSource`` among the places that Hydra composes from."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append it."""
        search_path.append(provider="lsvision", path=f"{SettingsSource.scheme()}://")


class SweepReport(Callback):
    """Hydra's hook at the end of a sweep."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Write the sweep's table and report; exit code 1 where a job failed."""
        from lsvision.experiments.sweep import collect_sweep

        jobs = collect_sweep(Path(config.hydra.sweep.dir))
        failed = [job for job in jobs if job.reason]
        for job in failed:
            print(f"error: job {job.name} ({' '.join(job.overrides)}): {job.reason}", file=sys.stderr)
        if failed:
            raise SystemExit(1)


def register_settings() -> None:
    """Make the nodes and resolvers known to Hydra; before anything is composed."""
    for plugin in (SettingsSource, SettingsPath):
        Plugins.instance().register(plugin)
    OmegaConf.register_new_resolver("own_folder", own_folder, use_cache=True, replace=True)


def own_folder(path: str) -> str:
    """Create a folder that no other run has: of two that start within a second, the second gets a number."""
    for name in itertools.chain([path], (f"{path}_{number}" for number in itertools.count(2))):
        try:
            Path(name).mkdir(parents=True)
        except FileExistsError:
            if not Path(name).is_dir():
                return path  # a file among its parents, which Hydra reports
        except OSError:
            return path
        else:
            return name
    return path


def _experiment_of(config_path: str) -> str:
    return config_path.removeprefix(_GROUP).removesuffix(".yaml")
