"""Doing the runs of a sweep by an executor: what is left of them, in order, whatever ends on the way."""

from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait

from sb3_quad.base.errors import WorkerDied
from sb3_quad.base.signals import StopSignals
from sb3_quad.executors import Executor
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.folder import Plan, SweepFolder
from sb3_quad.sweep.records import RunRecord
from sb3_quad.sweep.run import standing, work

Show = Callable[[int, int, str], None]  # runs that ended, runs in all, what is under way
TICK = 1.0  # s between two looks for a signal
TRIES = 2  # of a run whose worker process dies


def runs_left(place: SweepFolder, plan: Plan, records: Mapping[str, RunRecord], report: Callable[[str], None]) -> list[Run]:
    """The runs of a sweep that are not finished. Reports each that has already started, in one line."""
    left = []
    for run in plan.runs:
        record = records.get(run.name)
        if record is not None and record.state == "finished":
            continue
        left.append(run)
        words = standing(place.run(run))
        if record is not None:
            report(f"{run.name}: failed before ({record.message}); {words or 'begins again'}")
        elif words:
            report(f"{run.name}: {words}")
    return left


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
    records = place.records(plan.runs)
    left = runs_left(place, plan, records, report)
    records = {name: record for name, record in records.items() if record.state == "finished"}

    def submit(run: Run) -> None:
        runs[executor.submit(work, run, str(place.run(run)), plan.suite, plan.spec.evaluation)] = run
        tries[run.name] = tries.get(run.name, 0) + 1

    def progress() -> None:
        failed = sum(record.state == "failed" for record in records.values())
        words = f"{min(len(runs), executor.workers)} running" + (f", {failed} failed" if failed else "")
        show(len(records), len(plan.runs), words)

    runs, tries, stopped = dict["Future[RunRecord]", Run](), dict[str, int](), False
    for run in left:
        submit(run)
    progress()
    while runs:
        done = wait(runs, TICK, FIRST_COMPLETED).done
        for future in done:
            run = runs.pop(future)
            if future.cancelled():
                continue
            try:
                record = future.result()
            except WorkerDied as died:
                if stopped or signals.received is not None:
                    continue
                if tries[run.name] < TRIES:
                    report(f"{run.name}: {died}; {standing(place.run(run)) or 'begins again'}")
                    submit(run)
                    continue
                record = RunRecord(**run.identity, state="failed", message=str(died))
            if record.state == "interrupted":
                report(f"{run.name}: interrupted; {standing(place.run(run)) or 'not begun'} with --resume")
                continue
            place.add(record)
            records[run.name] = record
            report(f"{_in_words(record)} ({len(records)} of {len(plan.runs)})")
        if done:
            progress()
        if signals.received is not None and not stopped:
            stopped = True
            report(f"{signals.name}: the runs under way save and end")
            executor.stop()
    return records


def _in_words(record: RunRecord) -> str:
    if record.state == "failed":
        return f"{record.name}: failed: {record.message}"
    parts = []
    for scenario, measures in record.flights.items():
        success, rewards = measures.get("success"), [value for value in measures["reward"] if value is not None]
        rate = "" if success is None else f"success {100 * sum(value or 0 for value in success) / len(success):.1f} %, "
        parts.append(f"{scenario} {rate}reward {sum(rewards) / max(1, len(rewards)):.2f}")
    return f"{record.name}: {'; '.join(parts)}; {record.timesteps:,} timesteps in {record.seconds:.1f} s"
