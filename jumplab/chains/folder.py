"""A chain's result folder, written whole or not at all: ``chain.json``, ``chain.npz``, and a plan's folder per jump."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jumplab import store
from jumplab.chains.result import ChainResult
from jumplab.passport import Passport, write_passport
from jumplab.transactions import transaction

REPORT, LOG, JUMPS = "chain.json", "chain.npz", "jumps"


def write_chain(folder: str | Path, result: ChainResult, further: Mapping[str, str] | None = None, *,
                series: Mapping | None = None) -> tuple[Passport, ...]:  # fmt: skip
    """Write a chain; what an older chain left there goes.

    ``jumps/1``, ``jumps/2`` and so on are folders of plans like any other, which ``jumplab audit`` and others read.

    Parameters
    ----------
    further : names and texts of further files (the 3-D page).
    series : a report on many robots, becomes the entry ``series`` of ``chain.json``.

    Returns
    -------
    The audits of the plans, in the order of the jumps; they lie beside the plans as ``passport.json``.
    """
    audits = []
    with transaction(folder) as staging:
        (staging / JUMPS).mkdir()
        for jump in result.jumps:
            if jump.ahead is not None and jump.ahead.plan is not None:
                plan, place = jump.ahead.plan, staging / JUMPS / str(jump.number + 1)
                audits.append(store.write_plan(place, plan.tape, plan.robot, plan.summary, complete=write_passport))
        np.savez_compressed(staging / LOG, **result.arrays())
        for name, text in (further or {}).items():
            (staging / name).write_text(text, encoding="utf-8")
        report = {**result.to_json(), "versions": store.versions(), **({} if series is None else {"series": series})}
        (staging / REPORT).write_text(store.to_json(report), encoding="utf-8")
    return tuple(audits)
