"""Doing the runs of a sweep by an executor: what is left of them, in order, whatever ends on the way."""

from collections.abc import Callable, Mapping

from sb3_quad.base.errors import WorkerDied
from sb3_quad.base.signals import StopSignals
from sb3_quad.executors.protocol import Executor, Task
from sb3_quad.executors.travel import files_of, pack, unpack
from sb3_quad.sweep.expand import Run
from sb3_quad.sweep.folder import Plan, SweepFolder
from sb3_quad.sweep.records import RunRecord
from sb3_quad.sweep.run import EPISODES, Flying, fetch, standing, work, work_elsewhere

Show = Callable[[int, int, str], None]  # runs that ended, runs in all, what is under way
TICK = 1.0  # s between two looks for a signal
TRIES = 2  # of a run whose worker process dies


def what_is_left(place: SweepFolder, plan: Plan, records: Mapping[str, RunRecord], report: Callable[[str], None]) -> list[Run]:
    """The runs of a sweep that are not finished; told of each in one line that is there in part."""
    left = []
    for run in plan.runs:
        record = records.get(run.name)
        if record is not None and record.state == "finished":
            continue
        left.append(run)
        words = standing(run, place.run(run))
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
    left = what_is_left(place, plan, records, report)
    records = {name: record for name, record in records.items() if record.state == "finished"}
    flying = Flying(plan.suite, plan.spec.evaluation.episodes or EPISODES, plan.spec.evaluation.seed or 0)
    tasks = {_submit(place, plan, run, flying, executor): run for run in left}
    tries = dict.fromkeys((run.name for run in left), 1)
    stopped = False

    def progress() -> None:
        failed = sum(record.state == "failed" for record in records.values())
        waiting = executor.pending
        words = f"{min(waiting, executor.workers)} running" + (f", {failed} failed" if failed else "")
        show(len(records), len(plan.runs), words)

    progress()
    while executor.pending:
        done = executor.wait(TICK)
        for task in done:
            run = tasks.pop(task)
            try:
                record = _collect(place, run, task)
            except WorkerDied as died:
                if stopped or signals.received is not None:
                    continue
                if not executor.remote and tries[run.name] < TRIES:
                    tries[run.name] += 1
                    words = standing(run, place.run(run)) or "begins again"
                    report(f"{run.name}: {died}; {words}")
                    tasks[_submit(place, plan, run, flying, executor)] = run
                    continue
                record = RunRecord(
                    name=run.name, configuration=run.configuration, seed=run.seed, state="failed", message=str(died)
                )
            if record.state == "interrupted":
                report(f"{run.name}: interrupted; {standing(run, place.run(run)) or 'not begun'} with --resume")
                continue
            place.add(record)
            records[run.name] = record
            report(f"{_in_words(record)} ({len(records)} of {len(plan.runs)})")
        if done:
            progress()
        if signals.received is not None and not stopped:
            stopped = True
            report(f"{signals.name}: the runs under way save and end")
            executor.cancel()
    return records


def _submit(place: SweepFolder, plan: Plan, run: Run, flying: Flying, executor: Executor) -> Task:
    folder = place.run(run)
    if not executor.remote:
        return executor.submit(work, run, str(folder), flying)
    begun = pack(folder)
    home, storage = str(folder), _storage(place, plan)
    return executor.submit(work_elsewhere, run, flying, files_of(run.model_dump(mode="json")), begun, home, storage)


def _storage(place: SweepFolder, plan: Plan) -> str | None:
    """Where the runs of this sweep travel through, apart from those of others."""
    if plan.spec.storage is None:
        return None
    return f"{plan.spec.storage.rstrip('/')}/{place.path.resolve().name}"


def _collect(place: SweepFolder, run: Run, task: Task) -> RunRecord:
    outcome = task.result()
    if isinstance(outcome, RunRecord):
        return outcome
    record, stored = outcome
    unpack(fetch(stored), place.run(run))
    assert isinstance(record, RunRecord)
    return record


def _in_words(record: RunRecord) -> str:
    if record.state == "failed":
        return f"{record.name}: failed: {record.message}"
    parts = []
    for scenario, measures in record.flights.items():
        success, rewards = measures.get("success"), [value for value in measures["reward"] if value is not None]
        rate = "" if success is None else f"success {100 * sum(value or 0 for value in success) / len(success):.1f} %, "
        parts.append(f"{scenario} {rate}reward {sum(rewards) / max(1, len(rewards)):.2f}")
    return f"{record.name}: {'; '.join(parts)}; {record.timesteps:,} timesteps in {record.seconds:.1f} s"
