"""State the share of statements that the tests ran, by room: `python .ci/coverage_by_room.py` after `pytest --cov`.

Kernels do not count, since compiled code cannot be traced. Statements that run only in a process that a test starts
count as not run.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parents[1]


def room_of(path: Path) -> str:
    """Return the name of the room that a file belongs to: `georef_cli`, or a folder of `pipelines`."""
    package, *inside = path.parts
    return inside[0] if len(inside) > 1 and package == "pipelines" else package


def count_statements(measured: coverage.Coverage) -> tuple[Counter[str], Counter[str]]:
    """Return the number of statements, and of those that were run, by room."""
    present: Counter[str] = Counter()
    run: Counter[str] = Counter()
    for file in measured.get_data().measured_files():
        if not file.endswith(".py"):  # a template of a page, which runs as code under its own name
            continue
        _, statements, _, missing, _ = measured.analysis2(file)
        room = room_of(Path(file).resolve().relative_to(ROOT))
        present[room] += len(statements)
        run[room] += len(statements) - len(missing)
    return present, run


def main() -> None:
    """Print one line."""
    measured = coverage.Coverage(data_file=str(ROOT / ".coverage"), config_file=str(ROOT / "pyproject.toml"))
    measured.load()
    present, run = count_statements(measured)
    shares = [f"{room} {100 * run[room] / present[room]:.0f}" for room in sorted(present) if present[room]]
    whole = 100 * run.total() / max(present.total(), 1)
    sys.stdout.write(f"coverage: {whole:.0f} % of {present.total()} statements ({', '.join(shares)})\n")


if __name__ == "__main__":
    main()
