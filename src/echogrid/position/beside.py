"""Work that is done beside what the robot must not wait for: one task after the other, in a thread."""

import weakref
from collections import deque
from collections.abc import Callable
from threading import Condition, Thread
from typing import Any


class Beside:
    """Does tasks in their order in a thread, which ends with this object or with the program."""

    def __init__(self, do: Callable[[Any], Any], name: str):
        """No task yet.

        Args:
            do: does a task, and returns what came of it.
            name: of the thread.
        """
        self._work = _Work()
        thread = Thread(target=self._work.run, args=(do,), name=name, daemon=True)
        thread.start()
        self._end = weakref.finalize(self, self._work.end, thread)

    @property
    def found(self) -> Any:
        """What came of the last task that was done; None: of none yet.

        Raises:
            Exception: what a task raised; no further one is done.
        """
        if self._work.failed is not None:
            raise self._work.failed
        return self._work.found

    @property
    def waiting(self) -> int:
        """Tasks that are not done yet."""
        return self._work.waiting

    def put(self, task: Any) -> None:
        """Have a task done when those before it are."""
        self._work.put(task)

    def drop(self) -> None:
        """Forget the tasks that are not begun."""
        self._work.drop()

    def wait(self) -> None:
        """Return when all tasks are done; raises as ``found``."""
        self._work.wait()
        _ = self.found

    def close(self) -> None:
        """End when the task that is being done is; those behind it are not done."""
        self._end()


class _Work:
    """What the thread and its owner share."""

    def __init__(self) -> None:
        self.found: Any = None
        self.failed: Exception | None = None
        self._condition = Condition()
        self._todo: deque[Any] = deque()
        self._busy, self._closed = False, False

    @property
    def waiting(self) -> int:
        with self._condition:
            return len(self._todo) + self._busy

    def put(self, task: Any) -> None:
        with self._condition:
            self._todo.append(task)
            self._condition.notify_all()

    def drop(self) -> None:
        with self._condition:
            self._todo.clear()

    def wait(self) -> None:
        with self._condition:
            self._condition.wait_for(lambda: self._closed or self.failed or not (self._todo or self._busy))

    def run(self, do: Callable[[Any], Any]) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._closed or self._todo)
                if self._closed:
                    return
                task, self._busy = self._todo.popleft(), True
            try:
                self.found = do(task)
            except Exception as error:  # it is the owner's: raised when what was found is asked for
                self.failed, self._closed = error, True
            with self._condition:
                self._busy = False
                self._condition.notify_all()

    def end(self, thread: Thread) -> None:
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        thread.join()
