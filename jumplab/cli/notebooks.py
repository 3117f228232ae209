"""Runs the notebooks in order with papermill, under the very Python that runs this, and publishes what they made.

A chain works in ``OUT/.run``: the notebooks execute there with ``out = "result"`` and ``figures = "figures"``. Only
when the last one has passed are the results moved to OUT, the executed notebooks to ``OUT/notebooks`` and the figures
to their folder. A chain that fails leaves all of them as they were, and the notebook that failed in ``OUT/failed``.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumplab import errors
from jumplab.cli.parameters import STANDARD, check_parameters, check_value, declared_kinds, declared_parameters, literal
from jumplab.errors import InputError, JumplabError, as_path, require_type
from jumplab.io import folder as store
from jumplab.robot import Robot
from jumplab.task import JumpTask

__all__ = ["STANDARD", "RunReport", "check_parameters", "declared_parameters", "find_notebooks", "run_notebooks"]
PATTERN = "[0-9][0-9]_*.ipynb"
_PACKAGE_PARENT = Path(__file__).resolve().parent.parent.parent


@dataclass(frozen=True)
class RunReport:
    """Where a finished chain put its things, and how long it took.

    Attributes
    ----------
    out : result folder: plan, simulation, and the executed notebooks in ``notebooks``.
    figures : folder of the figures.
    notebooks : names of the notebooks, in the order in which they ran.
    wall_s : wall time of the whole chain [s].
    """

    out: Path
    figures: Path
    notebooks: tuple[str, ...]
    wall_s: float


# ---------------------------------------------------------------------------------------------- finding them


def find_notebooks(names: Sequence[str] = ()) -> list[Path]:
    """The package's notebooks in their order: beside the package (a checkout), else in ./notebooks.

    Parameters
    ----------
    names : which ones, by number or whole name ("02", "02_srmp"); all if empty.

    Raises
    ------
    InputError
        If there are none, since an installed package carries no notebooks; or none of a name.
    """
    places = list(dict.fromkeys(root / "notebooks" for root in (_PACKAGE_PARENT, Path.cwd())))
    for place in places:
        found = sorted(place.glob(PATTERN))
        if found:
            return _named(found, names)
    raise InputError(
        f"no notebooks in {' nor in '.join(repr(str(p)) for p in places)}; run this in a clone of the repository"
    )


def _named(found: list[Path], names: Sequence[str]) -> list[Path]:
    for name in names:
        if not any(name in (p.stem, p.stem[:2]) for p in found):
            raise InputError(f"no notebook {name!r}; there are {', '.join(p.stem for p in found)}")
    return [p for p in found if not names or {p.stem, p.stem[:2]} & set(names)]


# ---------------------------------------------------------------------------------------------- running them


def run_notebooks(
    parameters: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    figures: str | Path | None = None,
    notebooks: list[Path] | None = None,
    progress: bool = True,
) -> RunReport:
    """Execute the notebooks in order; each gets those parameters that it declares.

    Parameters
    ----------
    parameters : name -> value, for instance ``{"distance_m": 0.8}``.
    out : result folder; ``executed`` in the checkout if None.
    figures : folder of the figures; if None, ``figures`` in ``out`` if that is given, else in the checkout (or in its
        result folder where the checkout is read-only).
    notebooks : which ones; all of the package's if None.
    progress : show a bar per notebook on stderr.

    Raises
    ------
    InputError
        If a parameter is unknown to all notebooks or cannot be meant, or a folder cannot be written. Nothing has run.
    JumplabError
        If a cell fails: of the class that the cell raised, if that is one of the package's.
    """
    start = time.perf_counter()
    if parameters is not None:
        require_type(parameters, Mapping, "the notebooks' parameters")
    notebooks = [as_path(n, "a notebook").resolve() for n in notebooks or find_notebooks()]
    declared = {n: declared_parameters(n) for n in notebooks}
    kinds = {k: v for n in notebooks for k, v in declared_kinds(n).items()}
    values = _checked(dict(parameters or {}), set().union(*declared.values()), kinds)
    root = notebooks[0].parent.parent.parent
    asked = out is not None
    out = store.ensure_writable(out if asked else root / "executed").resolve()
    if figures is None and asked:
        figures = out / "figures"
    figures = _figures_folder(figures, root, out)
    with _workshop(out) as work:
        for i, notebook in enumerate(notebooks, start=1):
            given = {k: v for k, v in values.items() if k in declared[notebook]}
            label = f"{i}/{len(notebooks)} {notebook.stem}" if progress else None
            _execute(notebook, given, work, label, keep_failed=out / "failed")
        _publish(work, out, figures, sources=notebooks[0].parent)
    return RunReport(out, figures, tuple(n.stem for n in notebooks), time.perf_counter() - start)


def _checked(values: dict[str, Any], known: set[str], kinds: Mapping[str, type | range]) -> dict[str, Any]:
    kinds = {**kinds, **STANDARD}
    for name, value in values.items():
        if name in ("out", "figures"):
            raise InputError(f"the parameter {name!r} is set by the runner; use its own argument {name}")
        if name not in known:
            raise InputError(f"unknown notebook parameter {name!r}; the notebooks know {', '.join(sorted(known))}")
        if name in kinds:
            check_value(name, value, kinds[name])
    JumpTask(values.get("distance_m", 0.0), values.get("height_m", 0.5))
    if "robot" in values:
        Robot.load(values["robot"])
        if Path(values["robot"]).is_file():
            values["robot"] = str(Path(values["robot"]).resolve())
    return {**values, "out": "result", "figures": "figures"}


def _figures_folder(figures: str | Path | None, root: Path, out: Path) -> Path:
    if figures is not None:
        return store.ensure_writable(figures).resolve()
    with contextlib.suppress(InputError):
        return store.ensure_writable(root / "figures")
    return out / "figures"


@contextlib.contextmanager
def _workshop(out: Path) -> Iterator[Path]:
    """An empty ``.run`` in ``out``, for one chain at a time; gone at the end, however that comes."""
    executed, work = out / "notebooks", out / ".run"
    new = [p for p in (executed, out, *out.parents) if not p.exists()]
    executed.mkdir(parents=True, exist_ok=True)
    try:
        with store.locked(executed, wait_s=0.0):
            shutil.rmtree(work, ignore_errors=True)  # left by a chain that was killed
            for name in ("result", "figures", "notebooks"):
                (work / name).mkdir(parents=True)
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    finally:
        for p in new:
            with contextlib.suppress(OSError):  # only what is still empty goes
                p.rmdir()


def _execute(notebook: Path, given: dict[str, Any], work: Path, label: str | None, keep_failed: Path) -> None:
    import papermill
    from nbclient.exceptions import DeadKernelError
    from papermill.exceptions import PapermillExecutionError

    executed = work / "notebooks" / notebook.name
    with tempfile.TemporaryDirectory(prefix="jumplab-") as scratch:
        try:
            papermill.execute_notebook(
                literal(notebook), literal(executed), given, kernel_name="jumplab", language="python", cwd=str(work),
                progress_bar={"desc": label, "disable": None} if label else False,  # None: only on a terminal
                kernel_manager_class=_kernel_manager(Path(scratch), notebook.parent),
            )  # fmt: skip
        except PapermillExecutionError as e:
            keep_failed.mkdir(exist_ok=True)
            place = shutil.copy(executed, keep_failed)
            raise _explained(notebook.name, e, place) from e
        except DeadKernelError as e:
            raise JumplabError(f"notebook {notebook.name}: its Python process died; is there enough memory?") from e


def _explained(name: str, e: Any, place: str) -> JumplabError:
    """The error of a cell as one sentence, of the class that the cell raised if that is ours."""
    kind = getattr(errors, e.ename, None)
    ours = inspect.isclass(kind) and issubclass(kind, JumplabError)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(e.traceback))
    arrows = re.findall(r"^-+> \d+ (.*)$", plain, flags=re.MULTILINE)
    said = (e.evalue.strip().splitlines() or [""])[-1] or (arrows[-1].strip() if arrows else "no message")
    text = said if ours else f"{e.ename}: {said}"
    return (kind if ours else JumplabError)(f"notebook {name}, cell In [{e.exec_count}]: {text} (see {place})")


def _kernel_manager(scratch: Path, beside: Path) -> type:
    """Kernel manager that knows one kernel: this interpreter, with no user configuration, and the notebook's folder."""
    from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
    from jupyter_client.manager import AsyncKernelManager
    from traitlets import default

    path = [str(beside), *([os.environ["PYTHONPATH"]] if os.environ.get("PYTHONPATH") else [])]
    if (_PACKAGE_PARENT / "pyproject.toml").is_file():  # a checkout, perhaps not installed
        path.insert(0, str(_PACKAGE_PARENT))
    env = {
        "PYTHONPATH": os.pathsep.join(path),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        "IPYTHONDIR": str(scratch / "ipython"),
        "JUPYTER_RUNTIME_DIR": str(scratch),
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
        "JPY_SESSION_NAME": "",  # nobody looks, even if the runner was started from an open notebook
    }

    class ThisInterpreter(KernelSpecManager):
        def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
            argv = [sys.executable, "-Xfrozen_modules=off", "-m", "ipykernel_launcher", "-f", "{connection_file}"]
            escaped = {k: v.replace("$", "$$") for k, v in env.items()}
            return KernelSpec(argv=argv, env=escaped, language="python", display_name="Python of jumplab")

    class Manager(AsyncKernelManager):
        @default("kernel_spec_manager")
        def _kernel_spec_manager_default(self) -> KernelSpecManager:
            return ThisInterpreter(parent=self)

        @default("connection_file")
        def _connection_file_default(self) -> str:
            return str(scratch / "kernel.json")

        async def start_kernel(self, **kwargs: Any) -> None:
            # What cells print reaches the notebook another way; here would only come the kernel's own chatter.
            await super().start_kernel(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **kwargs)

    return Manager


# ---------------------------------------------------------------------------------------------- publishing


def _publish(work: Path, out: Path, figures: Path, sources: Path) -> None:
    with store.transaction(out) as staging:
        for p in (work / "result").iterdir():
            if p.is_file():
                os.replace(p, staging / p.name)
    for old in (out / "notebooks").glob(PATTERN):
        if not (sources / old.name).exists():  # executed once, since removed or renamed
            old.unlink()
    _place(work / "notebooks", out / "notebooks")
    _place(work / "figures", figures)
    shutil.rmtree(out / "failed", ignore_errors=True)


def _place(source: Path, target: Path) -> None:
    """Copy a tree's files, then rename all of them into their places, so that nobody finds half a file."""
    ready = []
    for p in sorted(q for q in source.rglob("*") if q.is_file()):
        final = target / p.relative_to(source)
        final.parent.mkdir(parents=True, exist_ok=True)
        half = final.with_name(f".{final.name}.half")
        shutil.copyfile(p, half)
        ready.append((half, final))
    for half, final in ready:
        os.replace(half, final)
