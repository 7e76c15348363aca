"""The CPUs that this process may use."""

import os

_most_cpus: int | None = None


def use_cpus(count: int) -> None:
    """Have this process use no more CPUs, as one of several that share a machine."""
    global _most_cpus
    _most_cpus = count


def available_cpus() -> int:
    """CPUs that this process may use."""
    count = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return count if _most_cpus is None else min(count, _most_cpus)
