"""Where functions are executed: worker processes of this machine, or a Ray cluster; one small seam for both."""

from sb3_quad.executors.protocol import Executor, Task, as_completed
from sb3_quad.executors.start import EXECUTORS, start_executor

__all__ = ["EXECUTORS", "Executor", "Task", "as_completed", "start_executor"]
