"""One study: cases by their keys; those on file are not done again, the others in parallel, and
each is kept at once.

A case is decided by its key alone, see :func:`key_of`. A study that was stopped therefore goes on
where it was, and gives what it would have given undisturbed; several studies may share a log.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import joblib
from tqdm import tqdm

from jumplab.errors import InputError, JumplabError
from jumplab.io import folder as store
from jumplab.io.files import Log, made, open_log
from jumplab.io.progress import tell

LOOK_S = 0.5  # how often a worker looks whether its parent still lives
PACKAGE = Path(__file__).parent.parent
# whose versions decide a result
DECIDING = ("jumplab", "casadi", "numpy", "pin", "proxsuite", "pybullet", "mujoco")
SHOWING = ("show", "cli", "api.py", "__main__.py", "notebooks")  # what decides no result
ANSWER_S = 10  # in which a cluster answers, or has none
# of processes that are started: they import nothing from the current folder, and the one of joblib
# that tidies up behind a command which was told to stop is silent
SILENT_AND_SAFE = {"PYTHONSAFEPATH": "1", "PYTHONWARNINGS": "ignore:resource_tracker"}
_CLUSTER: list[Any] = []  # client of the cluster that does the work, see on_cluster
_POOL = threading.RLock()  # joblib's processes are one pool, which threads use in turn
Task = tuple[Callable, tuple, dict]  # as :func:`joblib.delayed` makes it


Plain = dict[str, Any]  # data as JSON has them, of one case for example


# keys ------------------------------------------------------------------------------------------
def short_hash(data: Any) -> str:
    """64 bits of a hash of JSON data, enough to distinguish cases."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


@cache
def code(root: Path = PACKAGE) -> str:
    """Short hash of the sources that decide results."""
    files = sorted(f for f in root.rglob("*.py") if f.relative_to(root).parts[0] not in SHOWING)
    return short_hash(
        [[str(f.relative_to(root)), hashlib.sha256(f.read_bytes()).hexdigest()] for f in files]
    )


def key_of(*decisive: Any) -> str:
    """Name of a case: a short hash of all ``decisive`` plain data (target, robot's hash, settings),
    of the code and of the packages that it runs on.
    """
    return short_hash([decisive, *deciding().values()])


def deciding() -> dict[str, str]:
    """Words for all that decides results besides their case: the code here, and versions of
    packages.
    """
    versions = store.versions()
    return {"code": code()} | {name: versions[name] for name in DECIDING}


def check_numbers(n: int, seed: int, jobs: int | None) -> None:
    """Raise :class:`InputError` if one of these numbers (cases, seed, processes) is too small."""
    for name, value, least in (("n", n, 1), ("seed", seed, 0), ("jobs", jobs or 1, 1)):
        if value < least:
            raise InputError(f"{name} = {value} is too small; it must be at least {least}")


# the study -------------------------------------------------------------------------------------
@dataclass
class Study:
    """A study at work; made by :func:`open_study`, which says what its parts are."""

    log: Log | None
    bar: tqdm
    kind: type | None
    jobs: int | None
    resumed: int = 0  # cases that an earlier run had done

    def __post_init__(self):
        self._count = 0
        self.done: dict[str, Any] = {} if self.log is None else self.log.done  # by key

    def results(self, work: Mapping[str, Task]) -> list[Any]:
        """Do what the log does not have of ``work`` (tasks by key); all results, in its order."""
        missing = [
            joblib.delayed(_named)(k, task) for k, task in work.items() if k not in self.done
        ]
        self.resumed += len(work) - len(missing)
        self._advance(len(work) - len(missing))
        for name, result in in_parallel(missing, self.jobs):
            row = result if self.kind is None else result.to_json()
            row = json.loads(json.dumps(row))  # the very one that a resumed run reads
            if self.log is not None:
                self.log.add({"key": name, "row": row})
            self.done[name] = row if self.kind is None else self.kind.from_json(row)
            self._advance(1)
        return [self.done[name] for name in work]

    def _advance(self, cases: int) -> None:
        self._count += cases
        self.bar.update(cases)
        self.bar.refresh()
        if self.bar.total:
            tell("done", self._count, self.bar.total)


@contextmanager
def open_study(
    path: Path | None,
    command: str,
    kind: type | None = None,
    *,
    total: int | None = None,
    jobs: int | None = None,
    progress: bool | None = None,
) -> Iterator[Study]:
    """A study, whose finished cases (a line each) are kept until the block ends and after it.

    Parameters
    ----------
    path : of the log; a study without keeps nothing.
    command : of jumplab that this is.
    kind : of the results, with ``to_json`` and ``from_json``; others' lines are read around. If
        None, results are plain rows, and a log that has no line of such studies is refused.
    total : number of cases, where it is known beforehand.
    jobs : processes, by default one per core.
    progress : whether there is a bar; by default on a terminal only.

    Raises
    ------
    InputError
        If the log cannot be written, another process writes it, or it is something else's.
    """

    def entry(line: Any) -> tuple[str, Any]:
        row = line["row"]
        return line["key"], row if kind is None else kind.from_json(row)

    with ExitStack() as stack:
        log = None
        if path is not None:
            stack.enter_context(made(path.parent))
            log = stack.enter_context(open_log(path, command, entry))
            if kind is None and not (log.empty or log.done):
                raise InputError(
                    f"{str(path)!r} was not written by this version's 'jumplab {command}'; "
                    f"choose another folder"
                )
        hidden = None if progress is None else not progress
        bar = tqdm(total=total, unit="case", disable=hidden, dynamic_ncols=True)
        yield Study(log, stack.enter_context(bar), kind, jobs)


def _named(name: str, task: Task) -> tuple[str, Any]:
    return name, _done(task)


# processes -------------------------------------------------------------------------------------
def in_parallel(
    work: Sequence[Task], jobs: int | None = None, order: str = "generator_unordered"
) -> Iterator[Any]:
    """Results of ``work`` (n tasks), as they come unless ``order`` is "generator".

    In ``jobs`` processes, one per core if None; or where :func:`on_cluster` has it done. Raises
    :class:`JumplabError` if a process is killed.
    """
    if _CLUSTER:
        yield from _by_cluster(_CLUSTER[-1], work, order)
        return
    jobs = min(jobs or joblib.cpu_count(), len(work))
    if jobs <= 1:
        yield from map(_done, work)
        return
    begin = {"initializer": _serve, "initargs": (os.getpid(),)}
    with _POOL, _environment():
        try:
            yield from joblib.Parallel(jobs, return_as=order, max_nbytes=None, **begin)(work)
        except BrokenProcessPool as e:
            raise JumplabError(
                "a worker process was killed, perhaps for lack of memory; what was finished is "
                "kept: run it again, with fewer jobs at a time"
            ) from e


@contextmanager
def _environment() -> Iterator[None]:
    """Within the block, processes are started as :data:`SILENT_AND_SAFE` has it."""
    before = {name: os.environ.get(name) for name in SILENT_AND_SAFE}
    os.environ.update(SILENT_AND_SAFE)
    try:
        yield
    finally:
        for name in SILENT_AND_SAFE:
            del os.environ[name]
        os.environ.update({name: value for name, value in before.items() if value is not None})


@contextmanager
def on_cluster(address: str) -> Iterator[None]:
    """Within the block, work is done by the Dask scheduler at ``address``, "tcp://host:8786".

    Raises :class:`InputError` if none answers, it has no worker, or a worker has other versions
    than this process of what decides results.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs Dask: install jumplab[cluster]") from None
    try:
        client = Client(address, timeout=f"{ANSWER_S} s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as e:
        raise InputError(f"no Dask scheduler answers at {address!r} ({type(e).__name__})") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
            theirs = client.run(deciding)
        except (OSError, TimeoutError, ImportError, AttributeError) as e:
            raise InputError(
                f"the cluster at {address!r} has no worker with this version of jumplab "
                f"({type(e).__name__}); start one with 'dask worker'"
            ) from None
        for worker, values in theirs.items():
            for name, value in deciding().items():
                if values.get(name) != value:
                    raise InputError(
                        f"worker {worker} has {name} {values.get(name)}, this process {value}; "
                        f"install the same on both"
                    )
        _CLUSTER.append(client)
        try:
            yield
        finally:
            _CLUSTER.remove(client)


def _by_cluster(client: Any, work: Sequence[Task], order: str) -> Iterator[Any]:
    """Results of work from the workers of a cluster, however many threads they have."""
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    futures = [client.submit(_done, task, pure=False) for task in work]
    try:
        for future in futures if order == "generator" else as_completed(futures, loop=client.loop):
            yield future.result()
    except (KilledWorker, OSError) as e:
        raise JumplabError(
            f"the cluster has lost a worker ({type(e).__name__}); what was finished is kept: run "
            f"it again"
        ) from e
    finally:
        client.cancel(futures)


def _done(task: Task) -> Any:
    function, arguments, options = task
    return function(*arguments, **options)


def _serve(parent: int) -> None:
    """A worker's habits: Ctrl-C is its parent's affair, and without the parent there is nothing
    left to do.
    """

    def leave_with_it() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_S)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=leave_with_it, daemon=True).start()
