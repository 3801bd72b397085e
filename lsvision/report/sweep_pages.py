"""Report of a sweep: options and results of its jobs, and the reasons of the failures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lsvision.report.drawing import AFTER, label_axes, new_figure, whole_ticks
from lsvision.report.pages import Headline, Page, ReportFigure, Table, cell_text, write_report

# A page shows no more than these; the table on disk has all results.
_MOST_RESULTS = 8
_MOST_PANELS = 6


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep: name of its folder, overrides, reason of its failure or "", seconds, results by name."""

    name: str
    overrides: list[str]
    reason: str
    seconds: float | None
    results: Mapping[str, float | str | bool]

    @property
    def options(self) -> dict[str, str]:
        """Values of the overridden options by name."""
        return {name: value for name, _, value in (item.lstrip("+~").partition("=") for item in self.overrides)}


@dataclass(frozen=True)
class Sweep:
    """The jobs of a sweep, and which of their options and results a page shows."""

    jobs: Sequence[SweepJob]

    @property
    def done(self) -> list[SweepJob]:
        """Jobs with a result."""
        return [job for job in self.jobs if not job.reason]

    @property
    def failed(self) -> list[SweepJob]:
        """Jobs without a result."""
        return [job for job in self.jobs if job.reason]

    def varied_options(self) -> list[str]:
        """Options that differ between the jobs, in the order of the command line."""
        names = dict.fromkeys(name for job in self.jobs for name in job.options)
        return [name for name in names if len({job.options.get(name) for job in self.jobs}) > 1]

    def shown_results(self) -> list[str]:
        """Results for the table: the first of those that differ between the jobs, or of all if none does."""
        names = dict.fromkeys(name for job in self.done for name in job.results)
        differing = [name for name in names if len({job.results.get(name) for job in self.done}) > 1]
        return (differing or list(names))[:_MOST_RESULTS]

    def numeric_results(self) -> list[str]:
        """Shown results that are numbers in every job."""
        return [
            name
            for name in self.shown_results()
            if all(isinstance(job.results.get(name, 0.0), int | float) for job in self.done)
            and not any(isinstance(job.results.get(name), bool) for job in self.done)
        ]


def sweep_report(jobs: Sequence[SweepJob], folder: Path) -> None:
    """``report.html`` of a sweep, with links to the reports of its jobs."""
    sweep = Sweep(jobs)
    done, failed = len(sweep.done), len(sweep.failed)
    page = Page(
        title=f"Sweep of {len(jobs)} jobs",
        lead=(
            f"{done} jobs gave a result, {failed} failed. Varied: {', '.join(sweep.varied_options()) or 'nothing'}. "
            "sweep.parquet has every result of every job; each job's folder has its own report."
        ),
        headlines=[
            Headline("Results", str(done), f"of {len(jobs)} jobs"),
            Headline("Failed", str(failed), "reasons below" if failed else "none"),
        ],
        tables=[_results_table(sweep), *([_failures_table(sweep)] if failed else [])],
        figures=[results_by_job(sweep)] if sweep.numeric_results() else [],
        settings={job.name: job.overrides for job in jobs},
    )
    write_report(page, folder)


def results_by_job(sweep: Sweep) -> ReportFigure:
    """The first numeric results that differ, job by job."""
    names = sweep.numeric_results()[:_MOST_PANELS]
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure, axes = new_figure(10.5, 0.6 + 2.7 * rows, rows, columns)
    for panel, name in zip(axes, names, strict=False):
        points = [
            (int(job.name) if job.name.isdigit() else i, job.results[name])
            for i, job in enumerate(sweep.done)
            if name in job.results
        ]
        panel.plot(*zip(*points, strict=True), "o", ms=5, color=AFTER)
        label_axes(panel, name, "job [number]", f"{name} [{_unit(name)}]")
        panel.yaxis.label.set_fontsize(8)
        whole_ticks(panel)
    for panel in axes[len(names) :]:
        panel.remove()
    caption = (
        "The results that differ between the jobs. The table gives the options of every job; a job without a point "
        "failed."
    )
    return ReportFigure("results_by_job", "Results by job", caption, figure)


def _results_table(sweep: Sweep) -> Table:
    varied, shown = sweep.varied_options(), sweep.shown_results()
    rows = [
        (
            job.name,
            *(job.options.get(name, "") for name in varied),
            *(cell_text(job.results.get(name), digits=5) for name in shown),
        )
        for job in sweep.done
    ]
    return Table(
        "Results",
        ("job", *varied, *shown),
        rows,
        "Options and results that differ between the jobs; the number links to the report of the job.",
        [f"{job.name}/report.html" for job in sweep.done],
    )


def _failures_table(sweep: Sweep) -> Table:
    varied = sweep.varied_options()
    rows = [(job.name, *(job.options.get(name, "") for name in varied), job.reason) for job in sweep.failed]
    return Table("Failed jobs", ("job", *varied, "reason"), rows, "The log in the job's folder has the whole trace.")


def _unit(name: str) -> str:
    """The unit at the end of a result's name."""
    for ending, unit in (("_mm", "mm"), ("_deg", "deg"), ("_px", "px"), ("seconds", "s")):
        if name.endswith(ending):
            return unit
    return "1"
