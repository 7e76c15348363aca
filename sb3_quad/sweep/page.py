"""The report of a sweep: its tables as ``report.md``, and with the learning curves as one page, ``report.html``."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_quad.base.errors import ConfigError
from sb3_quad.evaluation.learning_curves import Curve, read_curve
from sb3_quad.evaluation.tables import Table
from sb3_quad.report.curves import plot_curves
from sb3_quad.report.page import Section, write_page
from sb3_quad.report.plots import Plot
from sb3_quad.sweep.folder import SweepFolder
from sb3_quad.sweep.results import SweepResults


def write_report(place: SweepFolder, found: SweepResults, shown: Mapping[str, Sequence[Table]]) -> Path:
    """Write the report of a sweep's finished runs: a section for each scenario and the learning curves.

    :param shown: the tables of :func:`~sb3_quad.sweep.results.tables`, by scenario.
    :return: the page.
    :raises ConfigError: a folder that cannot be written.
    """
    parts = [
        Section(f"scenario-{number}", scenario, "", flown, facts=flown[0].caption)
        for number, (scenario, flown) in enumerate(shown.items())
    ]
    plots = _curves(place, found)
    if plots:
        parts.append(Section("curves", "Learning curves", "Mean over seeds, with their range.", [], plots))
    configurations = len({run.configuration for run in found.plan.runs})
    facts = f"{found.finished} of {len(found.plan.runs)} runs of {configurations} configurations are finished."
    return write_page(place.path, f"Sweep: {found.plan.spec.name}", facts, parts)


def _curves(place: SweepFolder, found: SweepResults) -> list[Plot]:
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
