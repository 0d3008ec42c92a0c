"""Accuracy of the configurations by GNSS profile: `python examples/benchmarks/accuracy.py OUT --help`.

    accuracy.py OUT --orbit DATA            a survey folder with trajectory_rtk.csv, _consumer.csv, _outlier.csv
    accuracy.py OUT --seeds 0,1,2,3,4       surveys of `georef simulate`, one a seed

Of each survey the photographs are reconstructed once; each profile then gets a workspace of its own in OUT, on
which `georef compare` runs. What stands in OUT already is not made again. Prints a line a survey, profile and
configuration, and the medians over the surveys; `--json` FILE keeps them.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.options import resolve
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.recording import write_trajectory
from pipelines.simulate.stage import fly_survey

# Name of the profile, receiver, whether there are control points.
PROFILES = {
    "RTK": ("rtk", False),
    "RTK, 8 GCPs": ("rtk", True),
    "consumer, 8 GCPs": ("consumer", True),
    "consumer": ("consumer", False),
    "outliers": ("outliers", False),
    "outliers, 8 GCPs": ("outliers", True),
    "RTK, 15 % outliers": ("rtk_outliers", False),
    "PPK": ("ppk", False),
}
ORBIT_FILES = {
    "rtk": "trajectory_rtk.csv",
    "consumer": "trajectory_consumer.csv",
    "outliers": "trajectory_outlier.csv",
}
# What `georef simulate` is asked for, where a receiver is none of its own.
SIMULATED: dict[str, dict[str, Any]] = {"rtk_outliers": {"gnss": "rtk", "outlier_share": 0.15}}
OUTLIER_DEG = 5.0 / 111_000
FIGURES = (
    "test_psnr",
    "triangulated_mean_h_m",
    "triangulated_rmse_v_m",
    "surface_mean_h_m",
    "surface_median_h_m",
    "surface_rmse_v_m",
)


@dataclass(frozen=True)
class Survey:
    """A folder of photographs with control and check points, and the trajectories by receiver."""

    name: str
    folder: Path
    trajectories: dict[str, Path]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--orbit", type=Path)
    parser.add_argument("--seeds", default="")
    parser.add_argument("--images", type=int, default=48)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--profiles", default="RTK;consumer, 8 GCPs;consumer;outliers", help="separated by ;")
    parser.add_argument("--configs", default="A,E")
    parser.add_argument("--train", default="--preset fast", help="options of the trainings")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for survey in surveys(arguments):
        for profile in arguments.profiles.split(";"):
            rows += measured(survey, profile, arguments)
    print_medians(rows)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def surveys(arguments: argparse.Namespace) -> Iterator[Survey]:
    """The surveys, simulated where they are not there yet."""
    if arguments.orbit is not None:
        files = {receiver: arguments.orbit / name for receiver, name in ORBIT_FILES.items()}
        files["rtk_outliers"] = arguments.out / arguments.orbit.name / "trajectory_rtk_outliers.csv"
        replace_outliers(files["rtk"], files["outliers"], files["rtk_outliers"])
        yield Survey(arguments.orbit.name, arguments.orbit, files)
    for seed in filter(None, arguments.seeds.split(",")):
        yield simulated(int(seed), arguments)


def replace_outliers(exact: Path, with_outliers: Path, path: Path) -> None:
    """Write the fixes of one trajectory, but another's where that is metres off: the σ do not say which."""
    exact_rows, other_rows = (
        list(csv.DictReader(file.read_text(encoding="utf-8").splitlines())) for file in (exact, with_outliers)
    )
    for row, other in zip(exact_rows, other_rows, strict=True):
        away = max(abs(float(row[key]) - float(other[key])) for key in ("latitude", "longitude"))
        if away > OUTLIER_DEG:
            row.update({key: other[key] for key in ("latitude", "longitude", "altitude")})
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as handle:
        writer = csv.DictWriter(handle, exact_rows[0].keys())
        writer.writeheader()
        writer.writerows(exact_rows)


def simulated(seed: int, arguments: argparse.Namespace) -> Survey:
    """The photographs of one flight, and what each receiver would have recorded on it."""
    folder = arguments.out / f"seed{seed}" / "survey"
    flags = ("--images", arguments.images, "--size", arguments.size, "--seed", seed)
    if not folder.exists():
        georef("simulate", folder, *flags)
    files = {}
    for receiver in {PROFILES[profile][0] for profile in arguments.profiles.split(";")}:
        files[receiver] = folder / f"trajectory_{receiver}.csv"
        if not files[receiver].exists():
            options = {"images": arguments.images, "size": arguments.size, "seed": seed}
            options |= SIMULATED.get(receiver, {"gnss": receiver})
            config = resolve(SimulateOptions, {}, options, Path("georef.toml"))
            write_trajectory(files[receiver], fly_survey(config).recording.photos)
    return Survey(f"seed{seed}", folder, files)


def measured(survey: Survey, profile: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A row a configuration."""
    receiver, control = PROFILES[profile]
    home = arguments.out / survey.name
    base = home / "reconstruction"
    files = ("--images", survey.folder / "images", "--checkpoints", survey.folder / "checkpoints.txt")
    common = (*files, "--vertical", "ellipsoidal", "--sigma-mark", "0.2")
    if not (base / "sfm" / "sparse").exists():
        georef("ingest", base, *common, "--trajectory", survey.trajectories["rtk"])
        georef("sfm", base)
    workspace = home / profile.replace(",", "").replace(" ", "_").lower()
    gcp = ("--gcp", survey.folder / "gcp_list.txt") if control else ()
    georef("ingest", workspace, *common, "--trajectory", survey.trajectories[receiver], *gcp)
    georef("sfm", workspace, "--import", base / "sfm" / "sparse")
    table = georef("compare", workspace, "--configs", arguments.configs, *arguments.train.split(), "--json")
    rows = []
    for row in json.loads(table)["rows"]:
        figures = {
            "survey": survey.name,
            "profile": profile,
            "configuration": row["configuration"],
            "test_psnr": row["test_psnr"],
            **{
                f"{way}_{key}": row[way][key]
                for way in ("triangulated", "surface")
                for key in row[way]
                if key != "count"
            },
        }
        print(" ".join(_short(value) for value in figures.values()), flush=True)
        rows.append(figures)
    return rows


def georef(command: str, workspace: Path, *options: Any) -> str:
    """Run a command of georef; its standard output."""
    program = [sys.executable, "-c", "from georef_cli.main import main; main()"]
    arguments = [command, str(workspace), *map(str, options)]
    done = subprocess.run([*program, *arguments], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit(f"georef {' '.join(arguments)} failed")
    return done.stdout


def print_medians(rows: list[dict[str, Any]]) -> None:
    """Medians over the surveys, as a Markdown table."""
    keys = list(dict.fromkeys((row["profile"], row["configuration"]) for row in rows))
    print("\n| profile | configuration | surveys | " + " | ".join(FIGURES) + " |")
    print("|---" * (3 + len(FIGURES)) + "|")
    for profile, configuration in keys:
        mine = [row for row in rows if (row["profile"], row["configuration"]) == (profile, configuration)]
        values = [[row[figure] for row in mine if row[figure] is not None] for figure in FIGURES]
        cells = [_short(float(np.median(value))) if value else "–" for value in values]
        print(f"| {profile} | {configuration} | {len(mine)} | " + " | ".join(cells) + " |")


def _short(value: Any) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
