"""The notebooks: what each asks of its parameters, and the runner, papermill under the very Python that runs this.

A chain works in a staging folder, with ``out = "result"`` and ``figures = "figures"``. Only when the last notebook has
passed are the results moved to OUT, the figures to their folder and the executed notebooks to ``OUT/notebooks``. A
chain that fails leaves all of them as they were, and the notebook that failed in ``OUT/failed``.
"""

import ast
import contextlib
import json
import math
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from subprocess import DEVNULL
from typing import Any

from jumplab import errors
from jumplab.cli.common import Late
from jumplab.errors import InputError, JumplabError, as_path, quoted, require_type
from jumplab.task import JumpTask

store, robots, sim = Late("jumplab.io.folder"), Late("jumplab.robot"), Late("jumplab.sim")

STANDARD = {"distance_m": float, "height_m": float, "robot": str, "out": str, "figures": str}
PATTERN = "[0-9][0-9]_*.ipynb"
LOOK_S = 0.05  # how often it is looked whether a notebook has failed
_PACKAGE = Path(__file__).resolve().parent.parent
_PACKAGE_PARENT = _PACKAGE.parent


def check_parameters(namespace: Mapping[str, Any], **extra: type | range) -> None:
    """Refuse (:class:`InputError`) injected parameters that a notebook does not know, and values that cannot be meant.

    papermill merely warns of an unknown name and then runs with the default. Call this in the cell after the
    parameters: ``check_parameters(globals(), samples=range(1, 10_001), fast=bool)``. ``extra`` are parameters beside
    the ``STANDARD`` ones: a type, or a range for a whole number within it. An ``engine`` must be there.
    """
    known = {**STANDARD, **extra}
    cells = [source for source in namespace.get("In", []) if source.startswith("# Parameters\n")]  # what papermill adds
    for target in (t for n in ast.walk(ast.parse("\n".join(cells))) if isinstance(n, ast.Assign) for t in n.targets):
        if isinstance(target, ast.Name) and target.id not in known:
            raise InputError(f"unknown notebook parameter {target.id!r}; this notebook knows {', '.join(known)}")
    for name, kind in known.items():
        if name in namespace:
            check_value(name, namespace[name], kind)
    if "engine" in extra:
        sim.engine_class(namespace.get("engine", sim.DEFAULT_ENGINE))
    if "distance_m" in namespace or "height_m" in namespace:
        JumpTask(namespace.get("distance_m", 0.0), namespace.get("height_m", 0.5))


def check_value(name: str, value: Any, kind: type | range) -> None:
    """Refuse (:class:`InputError`) a value that is not of the kind: a type, or a range of whole numbers."""
    if isinstance(kind, range):
        check_value(name, value, int)
        if value not in kind:
            raise InputError(f"parameter {name} must be {kind.start} ... {kind.stop - 1}, got {value}")
        return
    wanted = int | float if kind is float else kind
    if not isinstance(value, wanted) or (isinstance(value, bool) and kind is not bool):
        raise InputError(f"parameter {name} must be of type {kind.__name__}, got {quoted(value)}")
    if kind is float and not math.isfinite(value):
        raise InputError(f"parameter {name} must be finite, got {value}")
    if kind is str and (not value or "\0" in value):
        raise InputError(f"parameter {name} must be a name or a path, got {quoted(value)}")


def declared_parameters(notebook: Path) -> dict[str, type | range | None]:
    """A notebook's parameters, and what its own ``check_parameters`` asks of each, read without running it.

    None stands for what cannot be read that way: the notebook itself will still refuse it. Raises InputError.
    """
    from papermill import inspect_notebook

    try:
        found = {name: STANDARD.get(name) for name in inspect_notebook(literal(notebook))}
    except Exception as e:  # nbformat raises a whole zoo
        raise InputError(f"{notebook}: not a readable notebook ({type(e).__name__})") from e
    for cell in json.loads(notebook.read_bytes())["cells"]:
        with contextlib.suppress(SyntaxError, ValueError, TypeError):  # text, magics, a range of variables
            for call in ast.walk(ast.parse("".join(cell["source"]))):
                if isinstance(call, ast.Call) and ast.unparse(call.func) == "check_parameters":
                    found |= {k.arg: _kind(k.value) for k in call.keywords if k.arg in found}
    return found


def _kind(node: ast.expr) -> type | range | None:
    """``int``, ``bool``, ``float``, ``str``, or ``range(a, b)``, as it stands in a notebook; None for anything else."""
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "range":
        return range(*map(ast.literal_eval, node.args))
    return {k.__name__: k for k in (int, bool, float, str)}.get(ast.unparse(node))


def literal(path: Path) -> str:
    """Path for papermill, which would otherwise fill in what stands between braces."""
    return str(path).replace("{", "{{").replace("}", "}}")


@dataclass(frozen=True)
class RunReport:
    """Where a finished chain of notebooks put its things, and how long it took."""

    out: Path  # result folder: plan, simulation, and the executed notebooks in ``notebooks``
    figures: Path
    notebooks: tuple[str, ...]  # their names, in the order in which they ran
    wall_s: float  # of the whole chain [s]


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """The package's notebooks in their order: beside the package (a checkout), else those that it was installed with.

    ``names`` says which ones, by number or whole name ("02", "02_srmp"); all if empty. Raises InputError if there are
    none, or none of a name.
    """
    places = [root / "notebooks" for root in (_PACKAGE_PARENT, _PACKAGE)]
    found = next(filter(None, (sorted(place.glob(PATTERN)) for place in places)), None)
    if found is None:
        there = " nor in ".join(repr(str(p)) for p in places)
        raise InputError(f"no notebooks in {there}; install jumplab anew")
    for name in names:
        if not any(name in (p.stem, p.stem[:2]) for p in found):
            raise InputError(f"no notebook {name!r}; there are {', '.join(p.stem for p in found)}")
    return [p for p in found if not names or {p.stem, p.stem[:2]} & set(names)]


def run_notebooks(
    parameters: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    figures: str | Path | None = None,
    notebooks: list[Path] | None = None,
    progress: bool = True,
    jobs: int | None = None,
) -> RunReport:
    """Execute the notebooks, all of the package's if None; each gets those parameters that it declares.

    The first runs alone, since others use what it leaves in the result folder; the others then in their order,
    ``jobs`` at a time.

    Raises :class:`InputError`, before anything has run, if a parameter is unknown to all notebooks or cannot be meant,
    or a folder cannot be written; a :class:`JumplabError` if a cell fails, of the class that the cell raised if that is
    one of the package's.

    Parameters
    ----------
    parameters : name -> value, for instance ``{"distance_m": 0.8}``.
    out : result folder; if None, ``executed`` in the checkout, or where one is if there is no checkout.
    figures : their folder; if None, ``figures`` in ``out`` if that is given or there is no checkout, else in the
        checkout (or in its result folder where the checkout is read-only).
    progress : show a bar per notebook on stderr.
    jobs : notebooks side by side; one per core if None.
    """
    start = time.perf_counter()
    if parameters is not None:
        require_type(parameters, Mapping, "the notebooks' parameters")
    notebooks = [as_path(n, "a notebook").resolve() for n in notebooks or find_notebooks()]
    declared = {n: declared_parameters(n) for n in notebooks}
    values = _checked(dict(parameters or {}), declared.values())
    root, installed = notebooks[0].parent.parent, notebooks[0].is_relative_to(_PACKAGE)
    asked = out is not None
    out = store.ensure_writable(out if asked else (Path.cwd() if installed else root) / "executed").resolve()
    figures = _figures_folder(figures, out, None if asked or installed else root)
    executed = out / "notebooks"
    if executed.is_dir():
        with store.locked(executed, wait_s=0.0):
            pass  # another chain is refused at once
    with store.transaction(executed) as staging:
        work = staging / "work"
        for name in ("result", "figures"):
            (work / name).mkdir(parents=True)
        work_on, started = [], []
        for i, notebook in enumerate(notebooks, start=1):
            given = {k: v for k, v in values.items() if k in declared[notebook]}
            bar = progress and {"desc": f"{i}/{len(notebooks)} {notebook.stem}", "disable": None}  # on a terminal
            work_on.append(partial(_execute, notebook, given, work, bar, out / "failed", started))
        _side_by_side(work_on[:1], 1, started)
        _side_by_side(work_on[1:], jobs or os.cpu_count() or 1, started)
        for old in executed.glob(PATTERN):
            if not (notebooks[0].parent / old.name).exists():  # executed once, since removed or renamed
                old.unlink()
        _publish(work, out, figures)
        shutil.rmtree(work)
    shutil.rmtree(out / "failed", ignore_errors=True)
    return RunReport(out, figures, tuple(n.stem for n in notebooks), time.perf_counter() - start)


def _figures_folder(asked: str | Path | None, out: Path, checkout: Path | None) -> Path:
    """Where figures go: as asked, else in the checkout, else (there is none, or it is read-only) in ``out``."""
    if asked is None:
        asked = out / "figures"
        if checkout:
            with contextlib.suppress(InputError):
                asked = store.ensure_writable(checkout / "figures")
    return store.ensure_writable(asked).resolve()


def _checked(values: dict[str, Any], declared: Iterable[dict]) -> dict[str, Any]:
    known = sorted(set().union(*declared))
    for name, value in values.items():
        if name in ("out", "figures"):
            raise InputError(f"the parameter {name!r} is set by the runner; use its own argument {name}")
        if name not in known:
            raise InputError(f"unknown notebook parameter {name!r}; the notebooks know {', '.join(known)}")
        for kind in filter(None, (d.get(name) for d in declared)):
            check_value(name, value, kind)
    JumpTask(values.get("distance_m", 0.0), values.get("height_m", 0.5))
    if "robot" in values:
        robots.Robot.load(values["robot"])
        if Path(values["robot"]).is_file():
            values["robot"] = str(Path(values["robot"]).resolve())
    if "engine" in values:
        sim.engine_class(values["engine"])
    return {"engine": sim.DEFAULT_ENGINE, **values, "out": "result", "figures": "figures"}


def _execute(
    notebook: Path, given: dict[str, Any], work: Path, bar: dict | bool, failed: Path, started: list[int]
) -> None:
    import papermill
    from nbclient.exceptions import DeadKernelError

    executed = work.parent / notebook.name
    with tempfile.TemporaryDirectory(prefix="jumplab-") as scratch:
        kernel = {"kernel_name": "jumplab", "language": "python"}
        kernel["kernel_manager_class"] = _kernel(scratch, notebook, work, started)
        try:
            papermill.execute_notebook(literal(notebook), literal(executed), given, progress_bar=bar, **kernel)
        except papermill.PapermillExecutionError as e:
            failed.mkdir(exist_ok=True)
            place = shutil.copy(executed, failed)
            raise _explained(notebook.name, e, place) from e
        except DeadKernelError as e:
            raise JumplabError(f"notebook {notebook.name}: its Python process died; is there enough memory?") from e


def _side_by_side(work: Sequence[Callable[[], None]], jobs: int, started: Sequence[int]) -> None:
    """Do all of it in order, ``jobs`` at a time, in threads, where the notebooks' client takes no signals.

    After the first error, and interrupted, nothing more begins and the kernels, process groups that have ``started``,
    are killed.
    """
    left, raised = iter(work), []

    def lane() -> None:
        for task in left:
            try:
                task()
            except Exception as e:
                raised.append(e)

    lanes = [threading.Thread(target=lane, daemon=True) for _ in range(min(jobs, len(work)))]
    for thread in lanes:
        thread.start()
    try:
        while any(thread.is_alive() for thread in lanes) and not raised:
            time.sleep(LOOK_S)
    finally:
        if any(thread.is_alive() for thread in lanes):
            for _ in left:  # nobody shall do these
                pass
            for group in started:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(group, signal.SIGKILL)
            for thread in lanes:
                thread.join(0.3)
    if raised:
        raise raised[0]


def _explained(name: str, e: Any, place: str) -> JumplabError:
    """The error of a cell as one sentence, of the class that the cell raised if that is ours."""
    kind = getattr(errors, e.ename, None)
    ours = isinstance(kind, type) and issubclass(kind, JumplabError)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(e.traceback))
    arrows = re.findall(r"^-+> \d+ (.*)$", plain, flags=re.MULTILINE)
    said = (e.evalue.strip().splitlines() or [""])[-1] or (arrows[-1].strip() if arrows else "no message")
    text = said if ours else f"{e.ename}: {said}"
    return (kind if ours else JumplabError)(f"notebook {name}, cell In [{e.exec_count}]: {text} (see {place})")


def _kernel(scratch: str, notebook: Path, work: Path, started: list[int]) -> type:
    """Kernel manager whose one kernel is this interpreter, working in ``work``, its process added to ``started``.

    No user configuration counts, and the notebook's folder is on its path.
    """
    from jupyter_client.kernelspec import KernelSpec
    from jupyter_client.manager import AsyncKernelManager
    from traitlets import Unicode

    checkout = [_PACKAGE_PARENT] if (_PACKAGE_PARENT / "pyproject.toml").is_file() else []  # perhaps not installed
    path = [*checkout, notebook.parent, *filter(None, [os.environ.get("PYTHONPATH")])]
    env = {
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "IPYTHONDIR": f"{scratch}/ipython",
        "JUPYTER_RUNTIME_DIR": scratch,
        "JPY_SESSION_NAME": "",  # nobody looks, even if the runner was started from an open notebook
    }
    argv = [sys.executable, "-Xfrozen_modules=off", "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": argv, "env": {k: v.replace("$", "$$") for k, v in env.items()}, "language": "python"}

    class ThisInterpreter(AsyncKernelManager):
        kernel_spec = KernelSpec(**spec, display_name="Python of jumplab")
        connection_file = Unicode(f"{scratch}/kernel.json")

        async def start_kernel(self, **kwargs: Any) -> None:
            quiet = {"stdout": DEVNULL, "stderr": DEVNULL}  # cells print another way
            await super().start_kernel(**kwargs | quiet | {"cwd": str(work)})
            started.append(self.provisioner.pid)

    return ThisInterpreter


def _publish(work: Path, out: Path, figures: Path) -> None:
    store.settle()
    with store.transaction(out) as staging:
        for p in (work / "result").iterdir():
            if p.is_file():
                os.replace(p, staging / p.name)
    for p in (work / "figures").rglob("*"):
        if p.is_file():
            store.write_file(figures / p.relative_to(work / "figures"), p.read_bytes())
