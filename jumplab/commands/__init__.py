"""One module per command of the command line; each declares its options in ``add`` and does its work.

A command imports the heavy libraries only once its input has been read, so that a mistake is told at once.
"""

from jumplab.commands import audit, bench, export, plan, run, simulate, sweep, view

COMMANDS = (run, plan, simulate, audit, view, export, sweep, bench)  # in the order of ``jumplab --help``
