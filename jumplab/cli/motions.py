"""The commands about motion clips: judge, mend."""

import json
import math
from argparse import Namespace
from collections import Counter
from pathlib import Path
from typing import Any

import jumplab as jl
from jumplab import io
from jumplab.cli.common import given, print_summary
from jumplab.cli.common import judge as audited
from jumplab.errors import InfeasibleError

REPORT = "judged.json"
CHANGES = "mended.json"
RATES = (24, 25, 30, 50, 60, 100, 120, 200, 240)  # usual frames per second
OTHER = 1.1, 4.5  # ratio of a rate and the one that it was taken for
# relative, of a rate to what flights ask for: falls are within a quarter of g then, and those of
# public clips at their own rate within 22 %
NEAR = 0.12


def judge(args: Namespace) -> None:
    """Judge motion clips: find motions that no robot could do."""
    result = jl.judge(args.file, **given(jl.judge, args))
    reports = result if isinstance(result, list) else [result]
    passed = sum(report.passed for report in reports)
    rows = [report.row() for report in reports]
    failed = Counter(check.name for report in reports for check in report.failed)
    causes = {check.name: failed[check.name] for check in reports[0].checks}
    args.found |= {"clips": rows, "physical": passed, "causes": causes}
    args.found["reports"] = [json.loads(report.to_json()) for report in reports]
    if args.out:
        _write(args.out, reports, args.found)
    if len(reports) > 1:
        counts = [row | {"failed": len(r.failed)} for row, r in zip(rows, reports, strict=True)]
        print(jl.plots.table(counts, digits=3))
        listed = ", ".join(f"{name} {n}" for name, n in causes.items() if n)
        reasons = f"; not for: {listed}" if listed else ""
        print(f"physical: {passed} of {len(reports)} clips{reasons}")
        return
    (report,) = reports
    print(report.clip.line())
    print("contacts: " + ", ".join(f"{feet} {a:.2f} to {b:.2f} s" for feet, a, b in report.phases))
    print(report.table())
    if rate := _better_rate(report):
        words = f"at {rate} frames per second its flights would fall nearly freely: is "
        print(f"{words}{report.clip.fps:g} its rate?")
    if not report.passed:
        raise InfeasibleError(f"clip {report.line()}")


def _better_rate(report: Any) -> int | None:
    """The usual frame rate at which all flights of a clip nearest fall freely, if not its own."""
    falls = [-flight["acceleration_m_s2"][2] for flight in report.manifest["flights"]]
    if not falls or min(falls) <= 0:
        return None
    wanted = [report.clip.fps * math.sqrt(report.clip.robot.gravity / fall) for fall in falls]
    rate = min(RATES, key=lambda x: max(abs(math.log(want / x)) for want in wanted))
    ratio = max(rate / report.clip.fps, report.clip.fps / rate)
    there = max(abs(want / rate - 1) for want in wanted) < NEAR
    return rate if there and OTHER[0] < ratio < OTHER[1] else None


def _write(folder: str, reports: list[Any], summary: dict[str, Any]) -> None:
    """The reports as JSON, and of each clip a page in 3-D."""
    with io.folder.transaction(folder) as staging:
        (staging / REPORT).write_text(io.folder.to_json(summary), encoding="utf-8")
        for report in reports:
            title = report.line()
            page = jl.plots.page(report.clip.robot, plan=report.tape, title=title)
            page.save(staging / f"{report.clip.name}.html")


def mend(args: Namespace) -> None:
    """Mend a motion clip: plan the nearest motion that the robot can do."""
    from jumplab.auditing import write_audit

    mended = jl.mend(args.file, **given(jl.mend, args))
    plan = mended.plan

    def complete(folder: Path) -> Any:
        (folder / CHANGES).write_text(io.folder.to_json(mended.to_json()), encoding="utf-8")
        return write_audit(folder)

    report = io.folder.write_plan(args.out, plan.tape, plan.robot, plan.summary, complete=complete)
    args.found |= {"out": args.out, "plan": plan.summary, **mended.to_json()}
    print_summary(plan.summary)
    print(mended.line())
    print(jl.plots.table(mended.changes, ["what", "clip", "mended", "change"], digits=3))
    print(f"shaped most by: {', '.join(mended.binding) or 'no limit'}")
    audited(report, args.out)
