"""What an executor does: take tasks, hand them out as they are done, stop them."""

from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Protocol


class Task(Protocol):
    """A call of a function that was handed to an executor."""

    def result(self) -> Any:
        """What the function returned, of a task that is done.

        :raises WorkerDied: its worker ended before the function did; else whatever the function raised.
        """


class Executor(Protocol):
    """Runs functions in processes that each have one thread of PyTorch.

    A function is given by the name of its module, so it stands at the top of one; arguments and results are pickled.
    """

    @property
    def workers(self) -> int:
        """How many tasks run side by side, at most."""

    @property
    def remote(self) -> bool:
        """Whether tasks may run on a machine that does not see this one's folders."""

    @property
    def pending(self) -> int:
        """Tasks that are not handed out by :meth:`wait` yet."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Task:
        """Have a function called."""

    def wait(self, seconds: float | None = None) -> Sequence[Task]:
        """Wait until a task is done, at most for some seconds; those that are done by then, each once, or none."""

    def cancel(self) -> None:
        """Forget the tasks that have not begun, and ask those under way to stop; :meth:`wait` still hands these out."""

    def close(self) -> None:
        """End all workers, at once."""

    def __enter__(self) -> "Executor": ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


def as_completed(executor: Executor) -> Iterator[Task]:
    """The tasks of an executor, each as it is done, also those that are submitted meanwhile."""
    while executor.pending:
        yield from executor.wait()
