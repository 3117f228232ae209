"""Everything that is read from or written to disk.

In come tapes, simulations and reports; out go result folders, exports and logs, each whole or not
at all. Start at :mod:`jumplab.io.folder`; what a plan is on file is :class:`jumplab.io.tape.Tape`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach(
    __name__, submodules=["export", "files", "folder", "motion", "tape"]
)
