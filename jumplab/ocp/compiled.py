"""The small functions of a kept problem as machine code: made by a compiler in the background, used by later processes,
never needed. Their numbers are those of CasADi's interpreter; a plan takes about three quarters of the time.

The compiler is that of ``$JUMPLAB_CC`` (empty: none), else the one of the wheel ``ziglang``. Beside a problem's file
come the code, its check sum, or a file that says why there is none; all may be deleted.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shlex
import subprocess
import sys
import sysconfig
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import casadi as ca
import numpy as np

from jumplab.io.files import write_file

# no target of this machine alone, no fused multiply-add: the numbers stay those of the interpreter
FLAGS = ("-O1", "-fPIC", "-shared", "-ffp-contract=off", "-fno-sanitize=undefined")
LONGEST_S = 1800.0  # a compiler that needs longer is lost
TOGETHER_S = 600.0  # parts of one problem are kept within this time
SAME = 1e-9  # relative; a compiler that calls other sines may round otherwise
SUFFIX = f".{sysconfig.get_platform()}.so"
_working: list[subprocess.Popen] = []  # of this process, which waits for none of them


def compiler() -> list[str] | None:
    """The command that compiles C, or None."""
    named = os.environ.get("JUMPLAB_CC")
    if named is not None:
        return shlex.split(named) or None
    wheel = importlib.util.find_spec("ziglang") is not None
    return [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"] if wheel else None


def library(path: Path) -> Path | None:
    """Sound machine code of the problem kept at ``path``; if there is none, a compiler, if any, is put to work."""
    if compiler() is None:
        return None
    code = path.with_suffix(SUFFIX)
    try:
        if _sum(code.read_bytes()) == code.with_suffix(".sum").read_text():
            return code
    except OSError:
        pass
    _begin(path)
    return None


def function(code: Path, name: str) -> ca.Function:
    """One of the functions in ``code``."""
    how = {"enable_fd": True}  # by differences, slopes that only the explanation of a failure asks for
    return ca.external(name, str(code), how)


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _begin(path: Path) -> None:
    """Start the compiler, unless it failed before or somebody has begun."""
    claim, failed = path.with_suffix(".working"), path.with_suffix(".failed")
    if any(one.poll() is None for one in _working):
        return  # one at a time
    with suppress(OSError):
        if failed.exists() or (claim.exists() and time.time() - claim.stat().st_mtime < LONGEST_S):
            return
        claim.write_text(str(os.getpid()))
        quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        command = [sys.executable, "-m", "jumplab.ocp.compiled", str(path)]
        _working.append(subprocess.Popen(command, start_new_session=True, **quiet))


def build(path: Path) -> None:
    """Compile the functions of the problem kept at ``path``; writes the code and its sum, or why there is none."""
    try:
        with TemporaryDirectory() as scratch:
            content = _compiled(path, Path(scratch))
        code = path.with_suffix(SUFFIX)
        write_file(code, content)
        write_file(code.with_suffix(".sum"), _sum(content).encode())
    except Exception as e:  # whatever a compiler may do
        write_file(path.with_suffix(".failed"), f"{type(e).__name__}: {e}\n".encode())
    finally:
        path.with_suffix(".working").unlink(missing_ok=True)


def _compiled(path: Path, scratch: Path) -> bytes:
    """The code, after it has given the interpreter's numbers."""
    _, functions = json.loads(path.read_bytes().partition(b"\n")[2])
    known = {name: ca.Function.deserialize(f) for name, f, *_ in functions}
    generator = ca.CodeGenerator("code.c", {"with_header": False})
    for symbol, f in known.items():
        generator.add(ca.Function(symbol, f.sx_in(), f.call(f.sx_in())))
    generator.generate(f"{scratch}{os.sep}")
    source, code = scratch / "code.c", scratch / "code.so"
    command = [*compiler(), *FLAGS, "-o", str(code), str(source), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S)
    if done.returncode or not code.is_file():
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr.strip()[-2000:]}")
    rng = np.random.default_rng(0)
    for symbol, f in known.items():
        point = [rng.uniform(0.1, 0.9, f.size_in(i)) for i in range(f.n_in())]
        one, two = (np.array(g.call(point)[0].full()) for g in (f, ca.external(symbol, str(code))))
        if not np.allclose(one, two, rtol=SAME, atol=SAME, equal_nan=True):
            raise RuntimeError(f"{symbol}: the code gives other numbers than the interpreter")
    return code.read_bytes()


def build_all(path: Path) -> None:
    """Compile the file at ``path``, then those of other parts that were kept about the same time, one by one."""
    build(path)
    oldest = path.stat().st_mtime - TOGETHER_S
    for other in sorted(path.parent.glob(f"*{path.suffix}")):
        claim, done = other.with_suffix(".working"), (other.with_suffix(x) for x in (SUFFIX, ".failed"))
        with suppress(OSError):
            if other.stat().st_mtime < oldest or any(x.exists() for x in (claim, *done)):
                continue
            claim.write_text(str(os.getpid()))
            build(other)


if __name__ == "__main__":
    with suppress(AttributeError, OSError):
        os.nice(19)  # whoever plans goes first
    build_all(Path(sys.argv[1]))
