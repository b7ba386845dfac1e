"""Runs jobs on other machines, with an executor that submits them to a Dask scheduler."""

import re
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, InvalidStateError
from contextlib import contextmanager, suppress
from typing import Any

from ..errors import ConfigError, JobError
from ..plants.extras import import_extra
from ..runkit.provenance import EXTRAS, code, versions
from ..runkit.reporter import Reporter

ANSWERS_S = 10.0  # time limit for the first connection to the scheduler
ANSWER_LIMIT_S = 60.0  # time limit for an answer from the scheduler, also after a lost connection
WORKERS_S = 30.0  # time limit for the first worker to connect
ATTEMPTS = 5  # for a job that the scheduler has lost, or whose result has not arrived
ADDRESS = re.compile(r"(tcp|tls)://\[?(?P<host>[^\]]+)\]?:(?P<port>\d{1,5})")
COMMON_PACKAGES = ("retrim", "jax", "jaxlib", "equinox", "optax", "numpy", "python")
"""Packages whose versions must be equal on all machines, so that a flight does not depend on its machine."""


class Cluster(Executor):
    """An executor whose jobs run on the workers of a Dask scheduler.

    If a worker dies, its job runs again on another one. This ends when Dask considers the job itself to be the cause
    (see its ``allowed-failures``, three by default). A job that the scheduler loses while the connection is down also
    runs again. Each result is delivered once. This process does not open a listening port; it connects to the
    scheduler.
    """

    def __init__(self, address: str) -> None:
        """Connect to the scheduler, and compare versions.

        Args:
            address: ``tcp://HOST:PORT``, or ``tls://HOST:PORT`` with the certificates in Dask's own configuration.

        Raises:
            ConfigError: The address is invalid, no scheduler answers, it has no workers, or the versions differ.
            PlantError: Dask is not installed.
        """
        place = ADDRESS.fullmatch(address)
        if not place or not 1 <= int(place["port"]) <= 65_535:
            raise ConfigError(f"--on {address!r}: expected tcp://HOST:PORT or tls://HOST:PORT of a Dask scheduler")
        self.address = address
        distributed = import_extra("distributed", "dask", package="distributed", kind="--on")
        try:
            socket.create_connection((place["host"], int(place["port"])), ANSWERS_S).close()
            self._client = distributed.Client(address, timeout=ANSWER_LIMIT_S, set_as_default=False, name="retrim")
        except (OSError, TimeoutError, ValueError, TypeError) as error:
            raise ConfigError(f"--on {address}: no scheduler responds there ({_line(error)})") from error
        try:
            self._check()
        except BaseException:
            self._client.close()
            raise

    @property
    def page(self) -> str:
        """Address of the scheduler's dashboard."""
        return str(self._client.dashboard_link)

    @property
    def workers(self) -> int:
        """Current number of workers."""
        return len(self._client.nthreads())

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Submit a function call to a worker; see ``concurrent.futures.Executor``."""
        outer: Future[Any] = Future()
        self._start(outer, lambda: self._client.submit(call, ours(), fn, args, kwargs, pure=False), ATTEMPTS)
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Disconnect from the scheduler, which then drops unfinished jobs."""
        self._client.close()

    def _start(self, outer: "Future[Any]", submit: Callable[[], Any], attempts: int) -> None:
        """Start a job, and restart it if it is lost, up to the number of attempts."""
        try:
            inner = submit()
        except Exception as error:
            outer.set_exception(JobError(f"no job can be given to the scheduler at {self.address} ({_line(error)})"))
            return

        def over(done: Any) -> None:
            with suppress(InvalidStateError):  # the job was cancelled in the meantime
                if done.status == "error":
                    outer.set_exception(done.exception())
                    return
                status: object = done.status
                if done.status == "finished":
                    try:
                        outer.set_result(done.result())
                        return
                    except InvalidStateError:
                        raise
                    except Exception as error:  # the result was lost on its way from the worker, or is unreadable here
                        status = _line(error)
                    finally:
                        done.release()  # otherwise the worker would keep the result as well
                if attempts > 1 and not outer.done():
                    self._start(outer, submit, attempts - 1)
                else:
                    outer.set_exception(JobError(f"a job was lost {ATTEMPTS} times ({status})"))

        outer.add_done_callback(lambda future: inner.cancel() if future.cancelled() else None)
        inner.add_done_callback(over)

    def _check(self) -> None:
        """Compare the versions on all workers with those of this process."""
        try:
            self._client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError as error:
            raise ConfigError(f"--on {self.address}: no worker connected within {WORKERS_S:g} s") from error
        for worker, theirs in self._client.run(ours, on_error="return").items():
            if isinstance(theirs, BaseException):
                raise ConfigError(f"worker {worker} does not have this retrim ({_line(theirs)})")
            check_alike(theirs, f"worker {worker}")


@contextmanager
def join_cluster(address: str | None, reporter: Reporter) -> Iterator[Cluster | None]:
    """Yield the cluster at an address, and report its workers and dashboard; without an address, yield None."""
    if address is None:
        yield None
        return
    with Cluster(address) as cluster:
        reporter.say(f"{cluster.workers} workers at {address}; the scheduler's page is {cluster.page}")
        yield cluster


def ours() -> dict[str, str]:
    """Return the values that must be equal on all machines: the versions, and the digest of retrim's code."""
    result = versions()
    return {name: result.get(name, "missing") for name in (*COMMON_PACKAGES, *EXTRAS)} | {"code": code()}


def check_alike(theirs: dict[str, str], who: str) -> None:
    """Compare versions with those of this process.

    Args:
        theirs: Result of :func:`ours` in another process.
        who: Name of that process, for the message.

    Raises:
        ConfigError: The versions differ; the message lists each difference.
    """
    here = ours()
    if other := [f"{name} {theirs.get(name)}, here {here[name]}" for name in here if theirs.get(name) != here[name]]:
        raise ConfigError(f"{who} has different versions: {'; '.join(other)}")


def call(theirs: dict[str, str], fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a function on a worker; check versions first, since the worker may have joined after the earlier check."""
    from ..runkit.compile_cache import enable_compile_cache

    check_alike(theirs, "who sent this job to a worker")
    enable_compile_cache()
    return fn(*args, **kwargs)


def _line(error: BaseException) -> str:
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
