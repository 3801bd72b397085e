"""Report of a sweep: its jobs with what was varied and what came out, and why some failed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.ticker import MaxNLocator

from lsvision.report.drawing import AFTER, label_axes, new_figure
from lsvision.report.pages import Comparison, ReportFigure, Table, write_report

# More than a page shows well; the table on disk has all.
_MOST_RESULTS = 8
_MOST_PANELS = 6


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep: its folder's name, options, why it failed ("" if not), seconds, and results by name."""

    name: str
    overrides: list[str]
    reason: str
    seconds: float | None
    results: Mapping[str, float | str | bool]


def sweep_report(jobs: Sequence[SweepJob], folder: Path) -> None:
    """``report.html`` of a sweep, with links to the reports of its jobs."""
    done, failed = [job for job in jobs if not job.reason], [job for job in jobs if job.reason]
    varied = _varied(jobs)
    figures = [_results_by_job(done)] if _numeric(done) else []
    write_report(
        folder,
        title=f"Sweep of {len(jobs)} jobs",
        lead=(
            f"{len(done)} jobs gave a result, {len(failed)} failed. Varied: {', '.join(varied) or 'nothing'}. "
            "sweep.parquet has every result of every job; each job's folder has its own report."
        ),
        headlines=[
            Comparison("Results", str(len(done)), f"of {len(jobs)} jobs"),
            Comparison("Failed", str(len(failed)), "reasons below" if failed else "none"),
        ],
        tables=[_results_table(done, varied), *([_failures_table(failed, varied)] if failed else [])],
        figures=figures,
        settings={job.name: job.overrides for job in jobs},
    )


def _results_table(jobs: Sequence[SweepJob], varied: Sequence[str]) -> Table:
    shown = _shown(jobs)
    links = [f"{job.name}/report.html" for job in jobs]
    rows = [
        (job.name, *(_given(job).get(name, "") for name in varied), *(_cell(job.results.get(name)) for name in shown))
        for job in jobs
    ]
    return Table(
        "Results",
        ("job", *varied, *shown),
        rows,
        "What differs between the jobs; the number leads to a job's own report.",
        links,
    )


def _failures_table(jobs: Sequence[SweepJob], varied: Sequence[str]) -> Table:
    rows = [(job.name, *(_given(job).get(name, "") for name in varied), job.reason) for job in jobs]
    return Table("Failed jobs", ("job", *varied, "reason"), rows, "The log in the job's folder has the whole trace.")


def _results_by_job(jobs: Sequence[SweepJob]) -> ReportFigure:
    """The first numeric results that differ, job by job."""
    names = _numeric(jobs)[:_MOST_PANELS]
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure, axes = new_figure(10.5, 0.6 + 2.7 * rows, rows, columns)
    for panel, name in zip(axes, names, strict=False):
        points = [
            (int(job.name) if job.name.isdigit() else i, job.results[name])
            for i, job in enumerate(jobs)
            if name in job.results
        ]
        panel.plot(*zip(*points, strict=True), "o", ms=5, color=AFTER)
        label_axes(panel, name, "job [number]", f"{name} [{_unit(name)}]")
        panel.yaxis.label.set_fontsize(8)
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    for panel in axes[len(names) :]:
        panel.remove()
    caption = (
        "What came out of each job; the table says what its options were. Numbers missing on the axis are failures."
    )
    return ReportFigure("results_by_job", "Results by job", caption, figure)


def _varied(jobs: Sequence[SweepJob]) -> list[str]:
    """Options that differ between the jobs, in the order they were given."""
    given = [_given(job) for job in jobs]
    names = dict.fromkeys(name for options in given for name in options)
    return [name for name in names if len({options.get(name) for options in given}) > 1]


def _shown(jobs: Sequence[SweepJob]) -> list[str]:
    """Results to tabulate: those that differ between the jobs, the first of them."""
    names = dict.fromkeys(name for job in jobs for name in job.results)
    differing = [name for name in names if len({job.results.get(name) for job in jobs}) > 1]
    return (differing or list(names))[:_MOST_RESULTS]


def _numeric(jobs: Sequence[SweepJob]) -> list[str]:
    return [
        name
        for name in _shown(jobs)
        if all(isinstance(job.results.get(name, 0.0), int | float) for job in jobs)
        and not any(isinstance(job.results.get(name), bool) for job in jobs)
    ]


def _given(job: SweepJob) -> dict[str, str]:
    return {name.lstrip("+~"): value for name, _, value in (item.partition("=") for item in job.overrides)}


def _unit(name: str) -> str:
    """Unit that a result's name ends in."""
    for ending, unit in (("_mm", "mm"), ("_deg", "deg"), ("_px", "px"), ("seconds", "s")):
        if name.endswith(ending):
            return unit
    return "1"


def _cell(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else "" if value is None else str(value)
