"""Many tasks on many processes, here or on other machines: the one place that knows Dask.

`pool` opens a cluster of processes on this machine, or connects to a scheduler that is already there; `Pool.run` sends
tasks to it and hands back what came of each, in the order in which they end.  A worker that is lost costs only the task
it was busy with, and that is tried again.  A function that runs on a worker may report how far it is, see `link`.
"""

from __future__ import annotations

import os
import queue
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from mrtamp.problem import MrtampError
from mrtamp.workers import local_workers, remote_workers, uninterrupted

NO_WORKERS_S = 60.0
"""Seconds after which a run gives up when its scheduler has no worker; a worker that died here is back in a few."""
_TICK_S = 0.25
"""Seconds between two looks at how many workers there are while nothing else happens."""

Hear = Callable[[str, Any], None]
"""Takes what a task tells: its key and the message."""


@dataclass(frozen=True)
class Outcome:
    """What came of a task.

    Attributes
    ----------
    key : of the task.
    value : what the function returned; None where there is an error.
    error : the function's error with its traceback, or that its workers were lost; None where there is a value.
    attempts : how often it was started; more than once where a worker was lost.
    """

    key: str
    value: Any
    error: str | None
    attempts: int


# -- on the worker ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Told:
    """What a task told on its way."""

    key: str
    message: Any


@dataclass(frozen=True)
class Link:
    """The way back from a task to whoever runs it; good in any thread of the worker's process."""

    _worker: Any = None
    _topic: str = ""
    _task: str = ""

    def tell(self, message: Any) -> None:
        """Report something (plain data: numbers, strings, lists, dicts); it arrives at whoever runs the task."""
        if self._worker is not None:
            self._worker.log_event(self._topic, {"task": self._task, "message": message})

    @property
    def cancelled(self) -> bool:
        """Whether nobody waits for the task any more; it should end soon then."""
        if self._worker is None:
            return False
        state = self._worker.state.tasks.get(self._task)
        return state is None or state.state not in ("executing", "long-running")


_here = threading.local()


def link() -> Link:
    """The link of the task that this thread runs; outside of any, one that tells nobody and is never cancelled."""
    current: Link = getattr(_here, "link", None) or Link()
    return current


def _perform(function: Callable[..., Any], arguments: tuple[Any, ...], topic: str, task: str) -> tuple[bool, Any]:
    """Whether the function came to its end, and its value or else its error."""
    from distributed import get_worker

    _here.link = Link(get_worker(), topic, task)
    try:
        return True, function(*arguments)
    except BaseException as error:
        return False, f"{type(error).__name__}: {error}\n\n{traceback.format_exc()}"
    finally:
        _here.link = None


def end_with_parent(period_s: float = 0.5) -> None:
    """End this process when its parent is gone; for processes that a task starts on its own.

    A worker that is killed cannot take them along, and they would go on beside the next attempt.
    """
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(period_s)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# -- here -------------------------------------------------------------------------------------------------------------


class Pool:
    """Workers that take tasks; made by `pool`.

    Attributes
    ----------
    client : of Dask, connected to the scheduler.
    """

    def __init__(self, client: Any) -> None:
        self.client = client

    @property
    def size(self) -> int:
        """How many tasks run at the same time, at present.

        Raises
        ------
        MrtampError : the scheduler is gone.
        """
        try:
            return sum(self.client.nthreads().values())
        except (OSError, RuntimeError) as error:
            raise MrtampError(f"the connection to the scheduler {self._address} is lost ({error})") from None

    @property
    def _address(self) -> str:
        return self.client.scheduler.address if self.client.scheduler is not None else ""

    def run(
        self,
        function: Callable[..., Any],
        tasks: Iterable[tuple[str, tuple[Any, ...]]],
        retries: int = 2,
        hear: Hear | None = None,
    ) -> Iterator[Outcome]:
        """What comes of `function(*arguments)` for every task, in the order in which they end; else as `follow`.

        Parameters
        ----------
        hear : called, in this thread, with the key and the message of whatever a task tells.
        """
        for event in self.follow(function, tasks, retries):
            if isinstance(event, Outcome):
                yield event
            elif hear is not None:
                hear(event.key, event.message)

    def follow(
        self,
        function: Callable[..., Any],
        tasks: Iterable[tuple[str, tuple[Any, ...]]],
        retries: int = 2,
        limit_s: float | None = None,
    ) -> Iterator[Outcome | Told]:
        """Call `function(*arguments)` on a worker for every task, as many at a time as there are workers.

        What is still running when the caller stops asking (or is interrupted) is cancelled.

        Parameters
        ----------
        function : of a module that the workers can import.
        tasks : (key, arguments) of each, the keys all different; they are asked for as workers become free.
        retries : how often a task whose worker was lost is tried again.
        limit_s : seconds after which whatever still runs is cancelled, without an outcome.

        Raises
        ------
        MrtampError : the scheduler is gone, or has had no worker for a minute.
        """
        yield from _Run(self, function, retries).events(tasks, float("inf") if limit_s is None else limit_s)


@dataclass(eq=False)
class _Task:
    """A task on its way: its future, and how many workers it has cost so far."""

    key: str
    arguments: tuple[Any, ...]
    future: Any = None
    losses: int = 0


class _Run:
    """One call of `Pool.run`: whatever Dask reports, in threads of its own, arrives in one inbox."""

    def __init__(self, pool: Pool, function: Callable[..., Any], retries: int) -> None:
        self.pool = pool
        self.function = function
        self.retries = retries
        # The scheduler keeps what is said under a topic, but forgets a client's own when the client has gone.
        self.topic: str = pool.client.id
        self.inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self.under_way: dict[str, _Task] = {}

    def events(self, tasks: Iterable[tuple[str, tuple[Any, ...]]], limit_s: float) -> Iterator[Outcome | Told]:
        """What `Pool.follow` promises."""
        client, waiting, more = self.pool.client, iter(tasks), True
        client.subscribe_topic(self.topic, lambda event: self.inbox.put(("told", event[1])))
        client.subscribe_topic("all", self._notice_losses)
        last_seen = time.monotonic()
        end = last_seen + limit_s
        try:
            while time.monotonic() < end:
                # No more tasks than workers: one that waits on a worker would be lost with another.
                size = self.pool.size
                last_seen = time.monotonic() if size else last_seen
                if time.monotonic() - last_seen > NO_WORKERS_S:
                    raise MrtampError(
                        f"the scheduler {self.pool._address} has had no worker for {NO_WORKERS_S:g} s; "
                        f"{len(self.under_way)} tasks were under way"
                    )
                while more and len(self.under_way) < size:
                    key, arguments = next(waiting, (None, ()))
                    more = key is not None
                    if key is not None:
                        self._submit(_Task(key, arguments))
                if not more and not self.under_way:
                    return
                with suppress(queue.Empty):
                    kind, content = self.inbox.get(timeout=_TICK_S)
                    yield from getattr(self, f"_{kind}")(content)
        finally:
            with suppress(OSError, RuntimeError):
                client.unsubscribe_topic(self.topic)
                client.unsubscribe_topic("all")
                client.cancel([task.future for task in self.under_way.values()])

    def _submit(self, task: _Task) -> None:
        name = f"mrtamp-{uuid.uuid4().hex}"
        self.under_way[name] = task
        task.future = self.pool.client.submit(
            _perform, self.function, task.arguments, self.topic, name, key=name, pure=False
        )
        task.future.add_done_callback(lambda _: self.inbox.put(("finished", name)))

    def _notice_losses(self, event: tuple[float, Any]) -> None:
        """The scheduler's own account of a worker that went: which tasks, or results not fetched yet, went with it."""
        message = event[1]
        if isinstance(message, dict) and message.get("action") == "remove-worker":
            for name in (*message["processing-tasks"], *message["lost-computed-tasks"]):
                self.inbox.put(("lost", name))

    def _told(self, content: dict[str, Any]) -> Iterator[Told]:
        task = self.under_way.get(content.get("task", ""))
        if task is not None:
            yield Told(task.key, content["message"])

    def _lost(self, name: str) -> Iterator[Outcome]:
        """The scheduler starts it anew by itself, unless that was one loss too many."""
        task = self.under_way.get(name)
        if task is None:
            return
        task.losses += 1
        if task.losses > self.retries:
            del self.under_way[name]
            self.pool.client.cancel([task.future])
            error = f"its worker was lost, {task.losses} times in {task.losses} attempts: killed or out of memory"
            yield Outcome(task.key, None, error, task.losses)

    def _finished(self, name: str) -> Iterator[Outcome]:
        task = self.under_way.pop(name, None)
        if task is None:
            return
        from distributed import KilledWorker

        attempts = task.losses + 1
        try:
            good, value = task.future.result()
        except KilledWorker:
            # The scheduler has a patience of its own; ours is not at an end, or the task would not be under way.
            self._submit(_Task(task.key, task.arguments, losses=task.losses))
        except CancelledError:
            raise MrtampError(f"the connection to the scheduler {self.pool._address} was lost") from None
        except Exception as error:
            # The function, its arguments or its value did not get there or back.
            yield Outcome(task.key, None, f"{type(error).__name__}: {error}", attempts)
        else:
            yield Outcome(task.key, value, None, attempts) if good else Outcome(task.key, None, value, attempts)


@contextmanager
def pool(scheduler: str | None = None, workers: int = 1) -> Iterator[Pool]:
    """Workers for `Pool.run`, for as long as the block lasts.

    Workers are spawned: a script that uses them does so under `if __name__ == "__main__":`.

    Parameters
    ----------
    scheduler : address of a running Dask scheduler (`tcp://host:port`), whose workers are used as they are; None: a
        cluster of `workers` processes on this machine, each taking one task at a time, reachable from nowhere else.
    workers : how many processes; without meaning for a scheduler.

    Raises
    ------
    MrtampError : Dask is not installed, the scheduler does not answer, or its workers have other versions.
    """
    if workers < 1:
        raise MrtampError(f"found workers={workers}, expected a whole number from 1")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise MrtampError(
            "several runs side by side need Dask, which is not installed: pip install 'mrtamp[cluster]'"
        ) from None
    with ExitStack() as stack:
        # Whatever starts or ends processes is not left half done.
        with uninterrupted():
            client = stack.enter_context(remote_workers(scheduler) if scheduler is not None else local_workers(workers))
        try:
            yield Pool(client)
        finally:
            with uninterrupted():
                stack.close()
