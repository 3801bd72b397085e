"""The engine that works in this process."""

from collections import deque
from types import TracebackType

from lsvision.archive.engines.protocol import Finished
from lsvision.archive.tasks import Task, run_task


class InProcessEngine:
    """Runs tasks in this process, one after the other, each on as many threads as torch may use."""

    capacity = 1

    def __init__(self) -> None:
        self._waiting: deque[Task] = deque()

    def __enter__(self) -> "InProcessEngine":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def submit(self, task: Task) -> None:
        """Take a task."""
        self._waiting.append(task)

    def collect(self) -> list[Finished]:
        """Run the task that was submitted first."""
        task = self._waiting.popleft()
        return [(task, run_task(task))]
