"""``+experiment=view``: a product of any length on a local page in the browser."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from lsvision.errors import ConfigError
from lsvision.experiments.settings import RunSettings
from lsvision.schema import Text

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ViewSettings(RunSettings):
    """Options of the experiment: the product to look at, and the port of the page; 0 takes a free one."""

    product: Text
    port: Annotated[int, Ge(0), Le(65535)] = 0


def run_view(settings: ViewSettings, folder: Path) -> None:
    """Serve the page on 127.0.0.1 until Ctrl-C."""
    from lsvision.viewer.product_view import ProductView
    from lsvision.viewer.server import serve

    view = ProductView.of(settings.product)
    try:
        serve(view, settings.port, lambda url: log.info("%s: open %s in a browser; Ctrl-C ends", settings.product, url))
    except OSError as error:
        raise ConfigError(f"port: {settings.port} cannot be used: {error.strerror}") from None
