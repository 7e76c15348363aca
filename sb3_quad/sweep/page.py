"""The report of a sweep: its tables as ``report.md``, and with the learning curves as one page, ``report.html``."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.learning_curves import Curve, read_curve
from sb3_quad.evaluation.tables import Table, text_table
from sb3_quad.report.curves import plot_curves
from sb3_quad.report.page import Section, write_page
from sb3_quad.report.plots import Plot
from sb3_quad.sweep.folder import Plan, SweepFolder
from sb3_quad.sweep.records import RunRecord
from sb3_quad.sweep.results import Found


def write_report(
    place: SweepFolder, plan: Plan, records: Mapping[str, RunRecord], found: Found, shown: Mapping[str, Sequence[Table]]
) -> Path:
    """Write the report of a sweep's finished runs; a later one replaces it.

    :param found: what :func:`~sb3_quad.sweep.results.evaluate` says of them.
    :param shown: its tables, by scenario.
    :return: the page.
    :raises ConfigError: a folder that cannot be written; :class:`~sb3_quad.base.errors.MissingExtra` if the page alone could
        not be written.
    """
    parts = sections(place, plan, records, found, shown)
    return write_page(place.path, f"Sweep: {plan.spec.name}", _facts(plan, found), parts)


def sections(
    place: SweepFolder, plan: Plan, records: Mapping[str, RunRecord], found: Found, shown: Mapping[str, Sequence[Table]]
) -> list[Section]:
    """A section for each scenario, the learning curves, the runs."""
    parts = [
        Section(f"scenario-{number}", scenario, "", flown, facts=flown[0].caption)
        for number, (scenario, flown) in enumerate(shown.items())
    ]
    plots = _curves(place, found)
    if plots:
        parts.append(Section("curves", "Learning curves", "Mean over seeds, with their range.", [], plots))
    parts.append(Section("runs", "Runs", "", [_runs(plan, records)]))
    return parts


def _curves(place: SweepFolder, found: Found) -> list[Plot]:
    """A plot of the evaluations along the way; of pipelines, one for each algorithm and environment of a stage."""
    curves: dict[str, dict[str, list[Curve]]] = {}
    for name, group in found.groups.items():
        for record in group:
            for path in sorted((place.path / "runs" / record.name).glob("*/*/evaluations.npz")):
                kind = f"{path.parent.parent.name} {path.parent.name.rpartition('_')[0]}"
                curves.setdefault(kind, {}).setdefault(name, []).append(read_curve(path.parent))
    plots = []
    for number, (kind, groups) in enumerate(curves.items()):
        try:
            figure = plot_curves(groups, {}, kind)
        except ConfigError:  # nothing of what is shown was measured
            continue
        plots.append(Plot(f"curves_{number}", f"{kind}: success and reward along the training.", figure))
    return plots


def _runs(plan: Plan, records: Mapping[str, RunRecord]) -> Table:
    rows: list[Sequence[str]] = []
    for run in plan.runs:
        record = records.get(run.name)
        if record is None:
            rows.append((run.name, "not finished", "", ""))
        else:
            state = record.state if not record.message else f"{record.state}: {record.message}"
            rows.append((run.name, state, f"{record.timesteps:,}", f"runs/{run.name}/{record.agent}" if record.agent else ""))
    return text_table("", ("run", "state", "timesteps", "agent"), rows, align="left")


def _facts(plan: Plan, found: Found) -> str:
    return f"{found.n_finished} of {len(plan.runs)} runs of {len(plan.configurations)} configurations are finished."
