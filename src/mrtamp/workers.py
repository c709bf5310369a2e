"""Workers of Dask for `mrtamp.cluster`: started on this machine for a while, or found behind a scheduler."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from typing import Any

from mrtamp.problem import MrtampError

CONNECT_S = 5.0
"""Seconds in which a scheduler has to answer, and then to have a worker."""
_MUST_AGREE = ("python", "distributed", "dask", "mrtamp", "drake")
"""What has to be of the same version here and on every worker; of Python, the first two numbers."""


@contextmanager
def local_workers(workers: int) -> Iterator[Any]:
    """Dask's client of a cluster of `workers` processes on this machine, one task each at a time."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        # Tasks may start processes.
        "distributed.worker.daemon": False,
        # A profiler that looks at every thread a hundred times a second is no use here.
        "distributed.worker.profile.enabled": False,
    }
    environment = dict(os.environ)
    with dask.config.set(settings), _silenced():
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                # There is no dashboard, but a server behind it all the same: on a free port, for this machine only.
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
            with cluster, Client(cluster, set_as_default=False) as client:
                client.wait_for_workers(workers)
                try:
                    yield client
                finally:
                    client.close()
                    _end(cluster.workers.values())
        finally:
            # Dask sets variables for its workers here, too.
            for name in set(os.environ) - set(environment):
                del os.environ[name]


def _end(nannies: Iterable[Any]) -> None:
    """End workers at once, with whatever their tasks started: asked politely, they first wait for their tasks."""
    import psutil

    processes = []
    for nanny in nannies:
        nanny.close_gracefully()  # from now on it starts no worker in place of one that ends
        with suppress(psutil.NoSuchProcess):
            worker = psutil.Process(nanny.pid) if nanny.pid else None
            processes += [worker, *worker.children(recursive=True)] if worker is not None else []
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.kill()


async def _identity(scheduler: str) -> dict[str, Any]:
    from distributed.core import rpc

    async with rpc(scheduler, timeout=CONNECT_S) as server:
        return await asyncio.wait_for(server.identity(), CONNECT_S)


@contextmanager
def remote_workers(scheduler: str) -> Iterator[Any]:
    """Dask's client of a scheduler that is already there.

    Raises
    ------
    MrtampError : it does not answer, has no workers, or they have other versions.
    """
    from distributed import Client

    with _silenced():
        try:
            # In a thread of its own, because a notebook has a loop running in this one.
            with ThreadPoolExecutor(1) as executor:
                kind = executor.submit(asyncio.run, _identity(scheduler)).result()["type"]
        except Exception as error:
            # Anything may answer at a wrong port, and in any way.
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            if isinstance(error, TimeoutError):
                reason = f"nothing within {CONNECT_S:g} s"
            raise _wrong_address(scheduler, f"does not answer as one ({reason})") from None
        if kind != "Scheduler":
            raise _wrong_address(scheduler, f"is a {kind.lower()}")
        with warnings.catch_warnings():
            # Dask only warns of other versions; we look ourselves.
            warnings.simplefilter("ignore")
            client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        with client:
            _compare_versions(client, scheduler)
            yield client


def _wrong_address(scheduler: str, found: str) -> MrtampError:
    return MrtampError(
        f"--scheduler: {scheduler!r} {found}, expected the address of a running Dask scheduler, as in tcp://host:8786"
    )


def _compare_versions(client: Any, scheduler: str) -> None:
    """Refuse workers that could not take our tasks, or whose results would not compare with ours."""
    deadline = time.monotonic() + CONNECT_S
    while not client.nthreads():
        if time.monotonic() > deadline:
            raise MrtampError(f"--scheduler: {scheduler} has no workers; start some with: dask worker {scheduler}")
        time.sleep(0.1)
    found = client.get_versions(packages=["mrtamp", "drake"])
    ours = found["client"]["packages"]
    for address, worker in found["workers"].items():
        theirs = worker["packages"]
        different = [
            f"{name} {_short(name, theirs.get(name))} instead of {_short(name, ours.get(name))}"
            for name in _MUST_AGREE
            if _short(name, theirs.get(name)) != _short(name, ours.get(name))
        ]
        if different:
            raise MrtampError(
                f"--scheduler: the worker {address} of {scheduler} has {', '.join(different)}; install the same "
                "versions on all machines"
            )


def _short(name: str, version: str | None) -> str:
    if version is None:
        return "missing"
    return ".".join(version.split(".")[:2]) if name == "python" else version


@contextmanager
def _silenced() -> Iterator[None]:
    """Dask tells of lost workers in log messages; here they are outcomes."""
    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits for the end of the block, and a process that is made inside it never hears one.

    Ctrl-C in a terminal reaches every process of its group, but only this one decides what it means.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # Started by the first process that is made, it would lift the mask on its way.
    resource_tracker.ensure_running()
    came: list[int] = []
    watched = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _: came.append(number)) for number in watched]
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in zip(watched, before, strict=True):
            signal.signal(number, handler)
    for late in came:
        signal.raise_signal(late)
