"""Doing the runs of a sweep by an executor: what is left of them, in order, whatever ends on the way."""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future

from sb3_quad.base.errors import WorkerDied
from sb3_quad.base.signals import StopSignals
from sb3_quad.executors import Executor, as_they_end
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.folder import Plan, RunRecord, SweepFolder
from sb3_quad.sweep.run import pipeline_folder, work

Show = Callable[[int, int, str], None]  # runs that ended, runs in all, what they are called
TRIES = 2  # of a run whose worker process dies


def execute(
    place: SweepFolder, plan: Plan, executor: Executor, signals: StopSignals, show: Show, report: Callable[[str], None]
) -> dict[str, RunRecord]:
    """Do all runs that are not finished.

    A run whose worker process ends is tried once more, from its snapshot; one that fails is left, and the others go on.
    After a signal, the runs under way save and end.

    :param report: told of each event in one line.
    :return: the records of all runs that ended, those of earlier calls included, by name.
    :raises ConfigError: a folder that cannot be written, a full disk.
    """
    known = place.records(plan.runs)
    records = {name: record for name, record in known.items() if record.state == "finished"}
    calls, tries = dict["Future[RunRecord]", Run](), Counter[str]()

    def submit(run: Run) -> None:
        calls[executor.submit(work, run, str(place.run(run)), plan.suite, plan.spec.evaluation)] = run
        tries[run.name] += 1

    def next_step(run: Run) -> str:
        return "goes on where it was left" if pipeline_folder(place.run(run)) is not None else "begins again"

    for run in plan.runs:
        if run.name in records:
            continue
        if run.name in known:
            report(f"{run.name}: failed before ({known[run.name].message}); {next_step(run)}")
        elif pipeline_folder(place.run(run)) is not None:
            report(f"{run.name}: {next_step(run)}")
        submit(run)
    show(len(records), len(plan.runs), "runs")
    for run, future in as_they_end(executor, calls, signals, report):
        try:
            record = future.result()
        except WorkerDied as died:
            if signals.received is not None:
                continue
            if tries[run.name] < TRIES:
                report(f"{run.name}: {died}; {next_step(run)}")
                submit(run)
                continue
            record = RunRecord(**run.identity, state="failed", message=str(died))
        if record.state == "interrupted":
            report(f"{run.name}: interrupted; {next_step(run)} with --resume")
            continue
        place.add(record)
        records[run.name] = record
        how = f"failed: {record.message}" if record.state == "failed" else f"finished in {record.seconds:.1f} s"
        report(f"{run.name}: {how} ({len(records)} of {len(plan.runs)})")
        show(len(records), len(plan.runs), "runs")
    return records
