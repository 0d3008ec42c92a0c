"""Compare the estimate of a run with what it took: python examples/benchmarks/estimates.py WORKSPACE OPTIONS …

The options are those of `georef run`; the workspace must not exist yet. The first line of the table that is printed
says what others used of the machine meanwhile: the figures hold for an idle one. A second call, on another
workspace, is estimated by what the first has taught.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.jobs import pace


def georef(*words: object) -> str:
    """Run a command, and return what it prints as its result; its log goes to the terminal."""
    command = [sys.executable, "-P", "-m", "georef_cli", *map(str, words)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


def rows_of(estimate: dict[str, Any], workspace: Workspace) -> list[tuple[str, float, float]]:
    """Return stage, estimated and taken seconds of what has run."""
    rows = []
    for row in estimate["stages"]:
        manifest = workspace.manifest(BY_NAME[row["stage"]])
        if row["seconds"] is not None and manifest is not None:
            rows.append((row["stage"], row["seconds"], manifest.duration_s))
    return rows


def main() -> None:
    """Print a line a stage, and the total."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    args, options = parser.parse_known_args()
    if args.workspace.exists():
        parser.error(f"{args.workspace} exists: a stage that is done takes no time")
    estimate = json.loads(georef("run", args.workspace, *options, "--dry-run", "--json"))
    before = pace.ticks()
    georef("run", args.workspace, *options)
    used = os.times()
    share = pace.used_by_others(before, used.children_user + used.children_system)
    rows = rows_of(estimate, Workspace(args.workspace))
    print(f"others used {share:.0%} of this machine")
    print(f"{'stage':18}{'estimated':>10}{'taken':>10}{'taken/estimated':>17}")
    taken_s = sum(taken for _, _, taken in rows)
    for name, estimated, taken in (*rows, ("in all", estimate["total"]["seconds"], taken_s)):
        print(f"{name:18}{estimated:8.1f} s{taken:8.1f} s{taken / estimated:17.2f}")


if __name__ == "__main__":
    main()
