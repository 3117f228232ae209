"""Prints what a run of pytest skipped, one argument of pytest a line: `python .ci/skipped.py REPORT.xml`."""

import sys
from pathlib import Path
from xml.etree import ElementTree

found = {}
for case in ElementTree.parse(sys.argv[1]).iter("testcase"):
    if case.find("skipped") is not None:
        names = (case.get("classname") or case.get("name")).split(".")
        file = Path("tests", f"{names[names.index('tests') + 1] if 'tests' in names else names[0]}.py")
        name = case.get("name")
        found[f"{file}::{name}" if case.get("classname") and name else str(file)] = None
print("\n".join(found))
