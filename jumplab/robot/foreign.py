"""Robots in files of others: the front door names what reads them, since the core knows no
importer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# gives the module whose ``examine(name_or_path, repair).robot`` is that of what is no pair of files
# yet, and whose ``check_texts(urdf, config_text, where)`` refuses pairs by the same rules
importer: Callable[[], Any]
