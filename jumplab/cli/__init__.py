"""One module per command of the command line; each declares its options in ``add`` and does its work.

A command imports the heavy libraries only once its input has been read, so that a mistake is told at once.
"""

from jumplab.cli import audit, bench, chain, envelope, export, plan, robot, run, simulate, sweep, trials, view

# in the order of ``jumplab --help``
COMMANDS = (run, plan, audit, simulate, trials, chain, view, export, robot, envelope, sweep, bench)
