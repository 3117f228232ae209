"""The commands about motion clips: judge, mend."""

import json
from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import Any

from jumplab.cli.common import Late, pages, print_summary, robots, store, tables
from jumplab.cli.common import judge as audited
from jumplab.errors import InfeasibleError

auditing = Late("auditing")
studies = Late("studies")

REPORT = "judged.json"
CHANGES = "mended.json"


def judge(args: Namespace) -> None:
    """Judge motion clips: what of them no robot could do."""
    robot = robots.Robot.load(args.robot)
    found = auditing.clip.judge(args.file, robot, fps=args.fps, order=args.order)
    reports = found if isinstance(found, list) else [found]
    passed = sum(report.passed for report in reports)
    rows = [report.row() for report in reports]
    failed = Counter(check.name for report in reports for check in report.failed)
    causes = {check.name: failed[check.name] for check in reports[0].checks}
    args.found |= {"clips": rows, "physical": passed, "causes": causes}
    args.found["reports"] = [json.loads(report.to_json()) for report in reports]
    if args.out:
        _write(Path(store.ensure_writable(args.out)), reports, args.found)
    if len(reports) > 1:
        counts = [row | {"failed": len(r.failed)} for row, r in zip(rows, reports, strict=True)]
        print(tables.table(counts, digits=3))
        listed = ", ".join(f"{name} {n}" for name, n in causes.items() if n)
        reasons = f"; not for: {listed}" if listed else ""
        print(f"physical: {passed} of {len(reports)} clips{reasons}")
        return
    (report,) = reports
    print(report.clip.line())
    print("contacts: " + ", ".join(f"{feet} {a:.2f} to {b:.2f} s" for feet, a, b in report.phases))
    print(report.table())
    if not report.passed:
        raise InfeasibleError(f"clip {report.line()}")


def _write(folder: Path, reports: list[Any], found: dict[str, Any]) -> None:
    """The reports as JSON, and of each clip a page in 3-D."""
    with store.transaction(folder) as staging:
        (staging / REPORT).write_text(store.to_json(found), encoding="utf-8")
        for report in reports:
            title = report.line()
            page = pages.page(report.clip.robot, plan=report.tape, title=title)
            page.save(staging / f"{report.clip.name}.html")


def mend(args: Namespace) -> None:
    """The nearest motion to a clip that the robot can do, as a plan."""
    robot = robots.Robot.load(args.robot)
    store.ensure_writable(args.out)
    mended = studies.mend.mend(args.file, robot, fps=args.fps, order=args.order)
    plan = mended.plan

    def complete(folder: Path) -> Any:
        (folder / CHANGES).write_text(store.to_json(mended.to_json()), encoding="utf-8")
        return auditing.write_audit(folder)

    report = store.write_plan(args.out, plan.tape, plan.robot, plan.summary, complete=complete)
    args.found |= {"out": args.out, "plan": plan.summary, **mended.to_json()}
    print_summary(plan.summary)
    print(mended.line())
    print(tables.table(mended.changes, ["what", "clip", "mended", "change"], digits=3))
    print(f"shaped most by: {', '.join(mended.binding) or 'no limit'}")
    audited(report, args.out)
