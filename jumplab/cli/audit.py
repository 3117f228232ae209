"""``jumplab audit``: check a plan by a second code path."""

from __future__ import annotations

import argparse

from jumplab.cli.common import common_options, judge


def add(commands: argparse._SubParsersAction) -> None:
    """Declare ``jumplab audit``."""
    audit = commands.add_parser("audit", help="check a plan by a second code path", parents=[common_options()])
    audit.add_argument("dir", metavar="DIR", help="folder of a plan")
    audit.set_defaults(work=_audit)


def _audit(args: argparse.Namespace) -> None:
    from jumplab.io import folder as store

    store.read_plan(args.dir)  # refuses a damaged folder
    folder = store.ensure_writable(args.dir)

    from jumplab import auditing as passport

    with store.transaction(folder) as staging:
        audit = passport.write_audit(folder, into=staging)
    print(audit.table())
    judge(audit, args.dir)
