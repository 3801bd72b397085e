"""The report of measured responses."""

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import Camera
from lsvision.report.drawing import label_axes, new_figure
from lsvision.report.pages import Headline, Page, ReportFigure, Table, write_report
from lsvision.stages.response.measured import MeasuredResponse

_CHANNELS = {1: (("grey", "#333333"),), 3: (("red", "#d55e00"), ("green", "#009e73"), ("blue", "#0072b2"))}


def response_in_words(measured: Mapping[Camera, MeasuredResponse]) -> list[str]:
    """The responses of the cameras in plain words, one line each."""
    lines = []
    for camera, item in measured.items():
        seen = item.gain[~item.gain.isnan()]
        blind = f", {item.blind_columns} columns that do not see" if item.blind_columns else ""
        noise = f"; noise {item.noise[0]:.2f} codes in the dark, {item.noise[1]:.2f} on white"
        lines.append(
            f"{camera} camera: gain {float(seen.min()):.3f}..{float(seen.max()):.3f}, known to "
            f"{item.relative_sigma:.2%}; offset {float(item.offset.median()):.2f} codes"
            f"{noise if math.isfinite(item.noise[0]) else ''}{blind}"
        )
    return lines


def response_report(measured: Mapping[Camera, MeasuredResponse], method: str, settings: dict, folder: Path) -> None:
    """``report.html`` of measured responses: gain, its uncertainty and offset of every column and colour."""
    worst = max(item.relative_sigma for item in measured.values())
    seen = torch.cat([item.gain[~item.gain.isnan()] for item in measured.values()])
    page = Page(
        title="Response of the cameras' columns",
        lead=f"Offset and gain of every column and colour, from {method}. An even image is (raw - offset) / gain; "
        "gains are relative to the brightest columns of both cameras. " + ". ".join(response_in_words(measured)) + ".",
        headlines=[
            Headline("Gain", f"{float(seen.min()):.3f}..{float(seen.max()):.3f}", "of all columns and colours"),
            Headline("Known to", f"{worst:.2%}", "one sigma of a gain, relative, of the worse camera"),
            Headline("Blind", str(sum(item.blind_columns for item in measured.values())), "columns that do not see"),
        ],
        tables=[_table(measured)],
        figures=[
            _by_column("gain", "gain [of the brightest]", measured),
            _by_column("offset", "offset [codes]", measured),
            _by_column("sigma", "sigma of the gain [%]", measured),
        ],
        settings=settings,
    )
    write_report(page, folder)


def _table(measured: Mapping[Camera, MeasuredResponse]) -> Table:
    rows = [
        (
            camera, name, *(f"{float(value):.4g}" for value in _values_of(item, channel)),
        )
        for camera, item in measured.items()
        for channel, (name, _) in enumerate(_CHANNELS[item.gain.shape[1]])
    ]  # fmt: skip
    header = ("camera", "colour", "gain, lowest", "gain, highest", "sigma of the gain [%]", "offset [codes]")
    return Table("Cameras", header, rows, "Sigma and offset are medians over the columns.")


def _values_of(item: MeasuredResponse, channel: int) -> tuple[Tensor, ...]:
    gain = item.gain[:, channel]
    seen = gain[~gain.isnan()]
    sigma = 100 * (item.gain_sigma[:, channel] / gain).nanmedian()
    return seen.min(), seen.max(), sigma, item.offset[:, channel].median()


def _by_column(what: str, label: str, measured: Mapping[Camera, MeasuredResponse]) -> ReportFigure:
    figure, axes = new_figure(9.5, 2.9 * len(measured), len(measured), 1, sharex="all", sharey="all")
    for panel, (camera, item) in zip(axes, measured.items(), strict=True):
        values = {"gain": item.gain, "offset": item.offset, "sigma": 100 * item.gain_sigma / item.gain}[what]
        for channel, (name, color) in enumerate(_CHANNELS[values.shape[1]]):
            panel.plot(values[:, channel].numpy(), linewidth=0.5, color=color, label=name)
        label_axes(panel, f"{camera} camera", "column [px]", label)
    axes[0].legend(loc="best", fontsize=8)
    captions = {
        "gain": "What a column delivers for the same light. The slow fall to the ends is vignetting and the light of "
        "the reference; the noise from column to column belongs to the sensor.",
        "offset": "Codes that a column delivers without light.",
        "sigma": "How well a gain is known, by how much parts of the white reference differ.",
    }
    titles = {"gain": "Gain by column", "offset": "Offset by column", "sigma": "Uncertainty of the gain"}
    return ReportFigure(f"response_{what}", titles[what], captions[what], figure)
