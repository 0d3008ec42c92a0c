"""Correction of the cost model by what this machine's own runs took, kept in the user's cache.

Each run of a stage that was alone on the machine leaves its time over the model's, by processor and threads; the
median of the last runs corrects the next estimate; of two the shorter, since the first may have compiled kernels. A
machine whose cores others use teaches nothing, and is named.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import statistics
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.files import replace_text
from pipelines.core.machine import thread_count, user_cache

log = logging.getLogger(__name__)

_KEPT = 5  # runs of a stage
_FEWEST_STAGES = 3  # that ran here, from which on they tell something of the others
_MOST, _LEAST = 100.0, 0.01  # ratio, beyond which a file is damaged
_SHORTEST_S = 0.2  # of a run that says something
_BUSY = 0.25  # share of the cores that others use, from which a machine counts as loaded


@dataclass(frozen=True)
class Ticks:
    """Processor ticks of the machine since its start: all, idle, and stolen by other virtual machines."""

    total: int
    idle: int
    steal: int


def corrected(stage: str, modelled: float) -> float:
    """Return the seconds that a stage will take, by what earlier runs of it took on this machine.

    A stage that never ran here is taken to be as slow against its model as those that did, in the median: most of
    what they differ by from the machine of the model is the processor.
    """
    kept = _kept_paces()
    medians = {name: statistics.median_low(ratios) for name, ratios in kept.items() if ratios}
    if stage in medians:
        return modelled * medians[stage]
    return modelled * (statistics.median(medians.values()) if len(medians) >= _FEWEST_STAGES else 1.0)


def learn(stage: str, modelled: float | None, took_s: float) -> None:
    """Keep what a whole run of a stage took against the model."""
    if not modelled or took_s < _SHORTEST_S or not _LEAST < took_s / modelled < _MOST:
        return
    document = _document()
    ratios = document.setdefault(_key(), {}).setdefault(stage, [])
    document[_key()][stage] = [*ratios, round(took_s / modelled, 4)][-_KEPT:]
    try:
        _file().parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        replace_text(_file(), json.dumps(document))
    except OSError as error:
        log.debug("the time of %s cannot be kept in %s: %s", stage, _file(), error)


def ticks() -> Ticks | None:
    """Return the processor ticks of this machine; None where the system does not tell."""
    try:
        fields = [int(word) for word in Path("/proc/stat").read_text("ascii").splitlines()[0].split()[1:9]]
    except (OSError, ValueError, IndexError):
        return None
    return Ticks(sum(fields), fields[3] + fields[4], fields[7] if len(fields) > 7 else 0)


def used_by_others(before: Ticks | None, own_s: float) -> float:
    """Return the share of the cores that others used since `before`; `own_s` processor seconds were this run's."""
    after = ticks()
    if before is None or after is None or after.total <= before.total:
        return 0.0
    busy = (after.total - after.idle) - (before.total - before.idle)
    own_ticks = own_s * os.sysconf("SC_CLK_TCK")
    return max(busy - own_ticks, 0.0) / (after.total - before.total)


def is_loaded(share: float) -> bool:
    """Return whether others used so large a share (0 to 1) of the processors that a measured speed tells little."""
    return share > _BUSY


def load_sentence() -> str:
    """Return what others do with this machine, if it makes estimates too short; empty: it is idle, or not known."""
    cores = os.cpu_count() or 1
    try:
        load = os.getloadavg()[0]
    except (OSError, AttributeError):  # Windows has none
        return ""
    if load <= _BUSY * cores:
        return ""
    return (
        f"This machine is busy: load {load:.1f} on {cores} cores. The times are those of an idle one; "
        f"a run beside it takes up to {1 + load / cores:.1f} times as long."
    )


def _key() -> str:
    return f"{_processor()}, {thread_count()} threads"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", errors="replace").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _file() -> Path:
    return user_cache() / "pace.json"


def _document() -> dict[str, dict[str, list[float]]]:
    """Return the kept ratios by machine and stage; none of a file that is missing or damaged."""
    try:
        document = json.loads(_file().read_text(encoding="utf-8"))
        return {
            str(key): {str(stage): [float(ratio) for ratio in ratios] for stage, ratios in stages.items()}
            for key, stages in document.items()
        }
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}


def _kept_paces() -> dict[str, list[float]]:
    stages = _document().get(_key(), {})
    return {stage: [ratio for ratio in ratios if _LEAST < ratio < _MOST] for stage, ratios in stages.items()}
