"""The notebooks: what each asks of its parameters, and the runner, papermill under the very Python
that runs this.

A chain works in a staging folder, with ``out = "result"`` and ``figures = "figures"``. Only when
the last notebook has passed are the results moved to OUT, the figures to their folder and the
executed notebooks to ``OUT/notebooks``. A chain that fails leaves all of them as they were, and the
notebook that failed in ``OUT/failed``.
"""

import itertools
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from subprocess import DEVNULL
from typing import Any

import jumplab as jl
from jumplab import errors, io, reading, sim
from jumplab.arguments import fitting
from jumplab.cli import notebooks as places
from jumplab.errors import InputError, JumplabError, as_path, quoted, require_type
from jumplab.task import JumpTask

# two figures look different where a colour differs by more, in more than this share of the pixels
SEEN_DIFFERENCE = 32.0
SEEN_SHARE = 1e-3
STANDARD = ("distance_m", "height_m", "robot", "out", "figures")  # parameters of every notebook
TYPES = {kind.__name__: kind for kind in (int, bool, float, str)}
START_S = 180  # that a kernel has to answer, of which a busy machine takes most
Kinds = Mapping[str, type | range | None]  # of parameters; None can be anything


def check_parameters(namespace: Mapping[str, Any]) -> None:
    """Refuse (:class:`InputError`) injected parameters that a notebook does not know, and values
    that cannot be meant.

    papermill merely warns of an unknown name and then runs with the default. Call this in the cell
    after the parameters, with its ``globals()``. The kind of a parameter stands in the parameters'
    cell: its annotation and, of a whole number, a comment that begins with the range, as in
    ``samples: int = 200  # 1 ... 10000, random states``. An ``engine`` must be there.
    """
    for cell, injected in itertools.pairwise([*namespace.get("In", []), ""]):
        if not re.search(r"^distance_m: float = ", cell, re.M):
            continue
        from papermill.translators import PythonTranslator

        known = _kinds(p._asdict() for p in PythonTranslator.inspect({"source": cell}))
        if injected.startswith("# Parameters\n"):  # papermill's own cell
            for name in re.findall(r"^(\w+) = ", injected, re.M):
                if name not in known:
                    raise InputError(
                        f"unknown notebook parameter {name!r}; this notebook has {', '.join(known)}"
                    )
        for name, kind in known.items():
            check_value(name, namespace[name], kind)
    if "engine" in namespace:
        sim.engine_class(namespace["engine"])
    if "distance_m" in namespace or "height_m" in namespace:
        JumpTask(namespace.get("distance_m", 0.0), namespace.get("height_m", 0.5))


def check_value(name: str, value: Any, kind: type | range | None) -> None:
    """Refuse (:class:`InputError`) a value that is not of the kind: a type, or a range of whole
    numbers.
    """
    if kind is None:
        return
    fitting(value, int if isinstance(kind, range) else kind, f"parameter {name}")
    if isinstance(kind, range) and value not in kind:
        raise InputError(f"parameter {name} must be {kind.start} ... {kind.stop - 1}, got {value}")
    if kind is str and (not value or "\0" in value):
        raise InputError(f"parameter {name} must be a name or a path, got {quoted(value)}")


def declared_parameters(notebook: Path) -> Kinds:
    """Kinds of the parameters of a notebook, see :func:`check_parameters`; read without running it.
    Raises :class:`InputError` if it cannot be read.
    """
    from papermill import inspect_notebook

    try:
        return _kinds(inspect_notebook(_literal(notebook)).values())
    except Exception as e:  # nbformat raises a whole zoo
        raise InputError(f"{notebook}: not a readable notebook ({type(e).__name__})") from e


def _kinds(parameters: Iterable[Mapping[str, str]]) -> Kinds:
    """The kind of each of papermill's parameters."""
    kinds = {}
    for parameter in parameters:
        ends = re.match(r"(-?\d+) \.\.\. (-?\d+)", parameter["help"])
        kind = range(int(ends[1]), int(ends[2]) + 1) if ends else None
        kinds[parameter["name"]] = kind or TYPES.get(parameter["inferred_type_name"])
    return kinds


def _literal(path: Path) -> str:
    """Path for papermill, which would otherwise fill in what stands between braces."""
    return str(path).replace("{", "{{").replace("}", "}}")


@dataclass(frozen=True)
class RunReport:
    """Places of the results of a finished chain of notebooks, and its duration."""

    out: Path  # result folder: plan, simulation, and the executed notebooks in ``notebooks``
    figures: Path
    notebooks: tuple[str, ...]  # their names, in the order in which they ran
    wall_s: float  # of the whole chain [s]


def run_notebooks(
    parameters: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    figures: str | Path | None = None,
    notebooks: list[Path] | None = None,
    progress: bool = True,
    jobs: int | None = None,
) -> RunReport:
    """Execute the notebooks, all of the package's if None; each gets those parameters that it
    declares.

    The first runs alone, since others use what it leaves in the result folder; the others then in
    their order, ``jobs`` at a time.

    Raises :class:`InputError`, before anything has run, if a parameter is unknown to all notebooks
    or cannot be meant, or a folder cannot be written; a :class:`JumplabError` if a cell fails, of
    the class that the cell raised if that is one of the package's.

    Parameters
    ----------
    parameters : name -> value, for instance ``{"distance_m": 0.8}``.
    out : result folder; if None, ``executed`` in the checkout, or where one is if there is no
        checkout.
    figures : their folder, ``figures`` in ``out`` if None. One that is there stays if the new one
        looks the same.
    progress : show a bar per notebook on stderr.
    jobs : notebooks side by side; one per core if None.
    """
    start = time.perf_counter()
    if parameters is not None:
        require_type(parameters, Mapping, "the notebooks' parameters")
    notebooks = [as_path(n, "a notebook").resolve() for n in notebooks or places.find_notebooks()]
    declared = {n: declared_parameters(n) for n in notebooks}
    values = _checked(dict(parameters or {}), declared.values())
    root = notebooks[0].parent.parent
    installed = notebooks[0].is_relative_to(places.PACKAGE)
    if out is None:
        out = (Path.cwd() if installed else root) / "executed"
    out = io.folder.ensure_writable(out).resolve()
    figures = io.folder.ensure_writable(out / "figures" if figures is None else figures).resolve()
    executed = reading.below(out, "notebooks")
    reading.below(out, "failed")
    if executed.is_dir():
        with io.folder.locked(executed, wait_s=0.0):
            pass  # another chain is refused at once
    with io.folder.transaction(executed) as staging:
        work = staging / "work"
        for name in ("result", "figures"):
            (work / name).mkdir(parents=True)
        tasks = []
        groups: list[int] = []
        for i, notebook in enumerate(notebooks, start=1):
            given = {k: v for k, v in values.items() if k in declared[notebook]}
            # on a terminal
            bar = progress and {"desc": f"{i}/{len(notebooks)} {notebook.stem}", "disable": None}
            tasks.append(partial(_execute, notebook, given, work, bar, out / "failed", groups))
        _side_by_side(tasks[:1], 1, groups)
        _side_by_side(tasks[1:], jobs or os.cpu_count() or 1, groups)
        for old in executed.glob(places.PATTERN):
            # executed once, since removed or renamed
            if not (notebooks[0].parent / old.name).exists():
                old.unlink()
        publish(work, out, figures)
        shutil.rmtree(work)
    shutil.rmtree(out / "failed", ignore_errors=True)
    return RunReport(out, figures, tuple(n.stem for n in notebooks), time.perf_counter() - start)


def _checked(values: dict[str, Any], declared: Iterable[Kinds]) -> dict[str, Any]:
    known = sorted(set().union(*declared))
    for name, value in values.items():
        if name in ("out", "figures"):
            raise InputError(
                f"the runner sets the notebook parameter {name!r} itself; pass the folder as its "
                f"argument {name}"
            )
        if name not in known:
            raise InputError(
                f"unknown notebook parameter {name!r}; the notebooks have {', '.join(known)}"
            )
        for kinds in declared:
            check_value(name, value, kinds.get(name))
    JumpTask(values.get("distance_m", 0.0), values.get("height_m", 0.5))
    if "robot" in values:
        jl.Robot.load(values["robot"])
        if Path(values["robot"]).is_file():
            values["robot"] = str(Path(values["robot"]).resolve())
    values = {"engine": sim.DEFAULT_ENGINE, **values, "out": "result", "figures": "figures"}
    sim.engine_class(values["engine"])
    return values


def _execute(
    notebook: Path,
    given: dict[str, Any],
    work: Path,
    bar: dict | bool,
    failed: Path,
    groups: list[int],
) -> None:
    """Execute one notebook in ``work``, into the folder above; its process is added to
    ``groups``.
    """
    import papermill
    from nbclient.exceptions import DeadKernelError

    executed = work.parent / notebook.name
    with tempfile.TemporaryDirectory(prefix="jumplab-") as scratch:
        kernel = {"kernel_name": "jumplab", "language": "python"}
        kernel["kernel_manager_class"] = _kernel(scratch, notebook, work, groups)
        places = (_literal(notebook), _literal(executed))
        try:
            papermill.execute_notebook(
                *places, given, progress_bar=bar, start_timeout=START_S, **kernel
            )
        except papermill.PapermillExecutionError as e:
            failed.mkdir(exist_ok=True)
            place = shutil.copy(executed, failed)
            raise _explained(notebook.name, e, place) from e
        except DeadKernelError as e:
            raise JumplabError(
                f"notebook {notebook.name}: its Python process died; is there enough memory?"
            ) from e


def _side_by_side(tasks: Sequence[Callable[[], None]], jobs: int, groups: Sequence[int]) -> None:
    """Do all tasks in order, ``jobs`` at a time, in threads, where the notebooks' client takes no
    signals.

    After the first error, and interrupted, nothing more begins and the kernels, process ``groups``,
    are killed.
    """
    pool = ThreadPoolExecutor(jobs)
    try:
        for future in as_completed([pool.submit(task) for task in tasks]):
            future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for group in groups:
            with suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)


def _explained(name: str, e: Any, place: str) -> JumplabError:
    """The error of a cell as one sentence, of the class that the cell raised if that is ours."""
    kind = getattr(errors, e.ename, None)
    ours = isinstance(kind, type) and issubclass(kind, JumplabError)
    words = e.evalue.strip().rpartition("\n")[2]
    if not words:  # a bare assertion: its line
        plain = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(e.traceback))
        lines = re.findall(r"^-+> \d+ (.*)$", plain, re.M)
        words = lines[-1].strip() if lines else "no message"
    text = words if ours else f"{e.ename}: {words}"
    sentence = f"notebook {name}, cell In [{e.exec_count}]: {text} (see {place})"
    return kind(sentence) if ours else JumplabError(sentence)


def _kernel(scratch: str, notebook: Path, work: Path, groups: list[int]) -> type:
    """Kernel manager whose one kernel is this interpreter, working in ``work``, its process added
    to ``groups``.

    No user configuration counts, and the notebook's folder is on its path.
    """
    from jupyter_client.kernelspec import KernelSpec
    from jupyter_client.manager import AsyncKernelManager
    from traitlets import Unicode

    # perhaps not installed
    root = places.PACKAGE.parent
    checkout = [root] if (root / "pyproject.toml").is_file() else []
    path = [*checkout, notebook.parent, *filter(None, [os.environ.get("PYTHONPATH")])]
    env = {
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "IPYTHONDIR": f"{scratch}/ipython",
        "JUPYTER_RUNTIME_DIR": scratch,
        # nobody looks, even if the runner was started from an open notebook
        "JPY_SESSION_NAME": "",
    }
    launch = "-Xfrozen_modules=off -m ipykernel_launcher -f {connection_file}"
    env = {name: value.replace("$", "$$") for name, value in env.items()}

    class ThisInterpreter(AsyncKernelManager):
        kernel_spec = KernelSpec(argv=[sys.executable, *launch.split()], env=env, language="python")
        connection_file = Unicode(f"{scratch}/kernel.json")
        # kernels that start at the same time may be given the same free port; Windows has no ipc
        transport = Unicode("tcp" if os.name == "nt" else "ipc")

        async def start_kernel(self, **kwargs: Any) -> None:
            quiet = {"stdout": DEVNULL, "stderr": DEVNULL}  # cells print another way
            await super().start_kernel(**kwargs | quiet | {"cwd": str(work)})
            groups.append(self.provisioner.pid)

    return ThisInterpreter


def publish(work: Path, out: Path, figures: Path) -> None:
    """Move the results in ``work`` to ``out``, and its figures, but those that look the same; of
    these only captions that changed.
    """
    io.folder.settle()
    with io.folder.transaction(out) as staging:
        for p in (work / "result").iterdir():
            if p.is_file():
                os.replace(p, staging / p.name)
    made = work / "figures"
    files = [p.relative_to(made) for p in made.rglob("*") if p.is_file()]
    same = {
        p.with_suffix("") for p in files if p.suffix == ".png" and _alike(made / p, figures / p)
    }
    for p in files:
        old = figures / p
        kept = p.with_suffix("") in same
        if not kept or (p.suffix == ".txt" and _caption(made / p) != _caption(old)):
            io.folder.write_file(old, (made / p).read_bytes())


def _caption(path: Path) -> list[str]:
    """Lines of a figure's text, without its last one, the versions; none if it is missing."""
    return path.read_text(encoding="utf-8").splitlines()[:-1] if path.is_file() else []


def _alike(new: Path, old: Path) -> bool:
    """Whether two pictures look the same; the ``old`` one may be missing, or no picture."""
    import numpy as np  # both not before something is published
    from PIL import Image

    try:
        one, other = (np.asarray(Image.open(path).convert("RGB"), float) for path in (new, old))
    except (OSError, ValueError):
        return False
    if one.shape != other.shape:
        return False
    return float((np.abs(one - other).max(axis=2) > SEEN_DIFFERENCE).mean()) < SEEN_SHARE
