"""Where functions are executed: worker processes of this machine, or a Ray cluster; one small seam for both."""

from sb3_quad.executors.start import EXECUTORS, Executor, start_executor

__all__ = ["EXECUTORS", "Executor", "start_executor"]
