"""Run public flights of real drones and publish what came of them.

    real_flights.py DATA OUT                  run the flights of flights.toml that are in DATA; print the table
    real_flights.py DATA OUT --page docs      write docs/real_flights.md and its thumbnails, failures included

The photographs are downloaded by you, from the addresses in flights.toml. Each flight is a workspace in OUT, run at
one preset with its rasters and report; what stands there already is not made again. Its time is the sum of its
stages' times, its memory that of the run that ended it. A flight that fails has its error in the table. A flight
without a workspace in OUT keeps its row and section of the page, with version, machine and day of its own run.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Set
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.figures import length_text
from pipelines.core.manifest import Manifest
from pipelines.core.stages import STAGES
from pipelines.core.version import described_version
from pipelines.survey.report import EvaluationReport, PointRows, PredictedPointError, read_report

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
THUMBNAIL_PX = 480
BOUND = 2.0  # A vertical or horizontal error within 2 σ is bounded; 95 % are expected for one axis.


@dataclass(frozen=True)
class Flight:
    """A row of flights.toml."""

    name: str
    title: str
    source: str
    folder: str
    test: str
    commit: str = ""
    licence: str = "see the source"
    photographs: str = "images"
    size: str = ""
    sha256: str = ""
    gcp: str = ""
    checkpoints: str = ""
    options: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Run:
    """What one run of `georef` came to; `error` is its last message, empty where it ended well."""

    peak_mb: float
    error: str
    at: str
    version: str
    hardware: str


def main() -> None:
    """Run the flights that are there, print the table, and write the page if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder that holds the flights' folders")
    parser.add_argument("out", type=Path, help="folder for the workspaces")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--only", nargs="*", help="names of flights (default: all)")
    parser.add_argument("--page", type=Path, metavar="DOCS", help="folder of documents to write the page into")
    arguments = parser.parse_args()
    # The program runs in the repository's folder.
    arguments.data, arguments.out = arguments.data.absolute(), arguments.out.absolute()
    flights = [
        Flight(name, **row) for name, row in tomllib.loads((HERE / "flights.toml").read_text("utf-8")).items()
    ]
    present = [flight for flight in flights if (arguments.data / flight.folder).is_dir()]
    runs = {}
    for flight in present:
        if not arguments.only or flight.name in arguments.only:
            runs[flight.name] = run_flight(flight, arguments.data, arguments.out, arguments.preset)
        elif (record := record_of(arguments.out / flight.name)) is not None:
            runs[flight.name] = record
        else:
            continue
        print(row_of(flight, runs[flight.name], arguments.out / flight.name), flush=True)
    if arguments.page is not None:
        path = arguments.page / "real_flights.md"
        published = published_in(path.read_text("utf-8")) if path.is_file() else Published({}, {}, "")
        page = page_of(flights, runs, published, arguments, arguments.page / "images")
        path.write_text(page, encoding="utf-8")


def run_flight(flight: Flight, data: Path, out: Path, preset: str) -> Run:
    """Run a flight to its report, unless that is current; the record of the run stays beside the workspace."""
    folder, workspace = data / flight.folder, out / flight.name
    words = ["run", str(workspace), "--images", str(folder / flight.photographs), "--preset", preset]
    words += ["--deliver", "raster,report", *flight.options]
    for option, name in (("--gcp", flight.gcp), ("--checkpoints", flight.checkpoints)):
        words += [option, str(folder / name)] if name else []
    if flight.gcp:
        words += ["--set", "evaluate.cross_validate=true"]
    if flight.sha256 and (found := digest(folder / flight.photographs)) != flight.sha256:
        print(
            f"{flight.name}: other photographs than those of the published figures ({found[:12]}…)", file=sys.stderr
        )
    out.mkdir(parents=True, exist_ok=True)
    started, version, before = time.strftime("%Y-%m-%d"), described_version(), record_of(workspace)
    with (out / f"{flight.name}.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen([sys.executable, "-m", "georef_cli", *words], stdout=log, stderr=log, cwd=ROOT)
        _, status, usage = os.wait4(process.pid, 0)
    said = (out / f"{flight.name}.log").read_text("utf-8")
    error = (
        "" if os.waitstatus_to_exitcode(status) == 0 else (re.findall(r"(?m)^error: .*", said) or [said[-300:]])[-1]
    )
    run = Run(usage.ru_maxrss / 1024, error.removeprefix("error: "), started, version, hardware())
    if before is not None and not before.error and not run.error and run.peak_mb < before.peak_mb:
        return before  # Little was left to do.
    record_file(workspace).write_text(json.dumps(asdict(run)), encoding="utf-8")
    return run


def record_file(workspace: Path) -> Path:
    """Return where time and memory of a workspace's run are kept."""
    return workspace.with_suffix(".run.json")


def record_of(workspace: Path) -> Run | None:
    """Return what the run of a workspace took, or None."""
    path = record_file(workspace)
    return Run(**json.loads(path.read_text("utf-8"))) if path.is_file() else None


def digest(photographs: Path) -> str:
    """Return the SHA-256 over the sorted names and contents of a folder's photographs."""
    whole = hashlib.sha256()
    for path in sorted(path for path in photographs.iterdir() if path.is_file()):
        whole.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


@dataclass(frozen=True)
class Figures:
    """What a workspace holds: the manifests by stage, and the report of `evaluate`; what did not end is absent."""

    manifests: dict[str, Manifest]
    report: EvaluationReport | None


def figures_of(workspace: Path) -> Figures:
    """Return what the products of a workspace say."""
    folders = [workspace / spec.folder for spec in STAGES]
    found = [
        Manifest.model_validate_json((folder / "manifest.json").read_bytes())
        for folder in folders
        if is_made(folder)
    ]
    evaluated = is_made(workspace / "evaluate")
    report = read_report(workspace / "evaluate/report.json") if evaluated else None
    return Figures({manifest.stage: manifest for manifest in found}, report)


def is_made(folder: Path) -> bool:
    """Return whether a stage's folder has its product."""
    return (folder / "manifest.json").is_file()


def row_of(flight: Flight, run: Run, workspace: Path) -> str:
    """Return a flight's line of the table, in Markdown."""
    figures = figures_of(workspace)
    cells = [f"[{flight.title}](#{anchor(flight)})", registered(figures), f"{minutes(figures):.1f} min"]
    cells += [f"{run.peak_mb / 1000:.1f} GB", accuracy(figures), quality(figures), measured(figures)]
    return "| " + " | ".join([*cells, "failed" if run.error else str(len(remarks(figures)))]) + " |"


def anchor(flight: Flight) -> str:
    """Return the anchor of a flight's heading, as GitHub and the site make it."""
    return re.sub(r"[^\w\- ]", "", flight.title.lower()).replace(" ", "-")


def minutes(figures: Figures) -> float:
    """Return the time of all stages in minutes."""
    return sum(manifest.duration_s for manifest in figures.manifests.values()) / 60


def registered(figures: Figures) -> str:
    """Return how many photographs of the survey the model has."""
    values = figures.manifests["sfm"].values if "sfm" in figures.manifests else None
    if not values:
        return "–"
    of_rig = ""
    if "companions" in values:
        of_rig = f", and {values['companions_registered']} of {values['companions']} of the other lenses"
    return f"{values['registered']} of {values['images']}{of_rig}"


def accuracy(figures: Figures) -> str:
    """Return the accuracy as the program states it; where it is measured, with the predicted σ beside it."""
    report = figures.report
    if report is None:
        return "–"
    if report.headline.kind != "measured":
        return report.headline.of_points
    points = report.checkpoints.triangulated
    stated = points.predicted
    pair = f"H {length_text(stated.rms_h_m)}, V {length_text(stated.rms_v_m)}" if stated is not None else "none"
    return f"{report.headline.of_points}; predicted σ {pair}; {bounding_rate(points.points)}{left_out(report)}"


def bounding_rate(points: PointRows) -> str:
    """Return how many errors of check points, by axis, lie within 2 σ."""
    pairs = [
        pair
        for point in points
        if isinstance(point, PredictedPointError) and point.sigma_m is not None
        for pair in zip((point.de_m, point.dn_m, point.du_m), point.sigma_m, strict=True)
    ]
    within = [abs(error) <= BOUND * sigma for error, sigma in pairs if error is not None]
    return f"{sum(within)} of {len(within)} errors within {BOUND:g} σ"


def left_out(report: EvaluationReport) -> str:
    """Return the errors of the control points, each left out in turn."""
    found = report.cross_validation
    if found is None or found.rmse_h_m is None:
        return ""
    pair = f"H {length_text(found.rmse_h_m)}, V {length_text(found.rmse_v_m)}"
    return f"; {found.count} control points, each left out: {pair}"


def quality(figures: Figures) -> str:
    """Return the PSNR of the test views over covered pixels."""
    test = figures.report.test_views if figures.report is not None else None
    return f"{test.psnr_covered:.1f} dB" if test is not None and test.psnr_covered is not None else "–"


def measured(figures: Figures) -> str:
    """Return the share of the delivered area that was measured, and that area."""
    values = figures.manifests["export-raster"].values if "export-raster" in figures.manifests else None
    return f"{100 * values['measured']:.0f} % of {values['area_ha']:.2f} ha" if values else "–"


def remarks(figures: Figures) -> dict[str, str]:
    """Return the code of each warning and caution by its sentence."""
    notes = [note for manifest in figures.manifests.values() for note in (*manifest.warnings, *manifest.cautions)]
    return {note.sentence: note.code for note in notes}


def common_remarks(flights: list[dict[str, str]]) -> set[str]:
    """Return the codes of the remarks that more than half of the flights have, of three or more."""
    codes = Counter(code for texts in flights for code in set(texts.values()))
    return {code for code, count in codes.items() if len(flights) > 2 and 2 * count > len(flights)}


@dataclass(frozen=True)
class Published:
    """What a page says: rows and sections of flights by their titles, and the line of remarks in common."""

    rows: dict[str, str]
    sections: dict[str, str]
    shared: str


def published_in(page: str) -> Published:
    """Return what a page says of the flights that it has."""
    rows = {match[1]: match[0] for match in re.finditer(r"(?m)^\| \[([^\]]+)\]\(#.*$", page)}
    parts = re.split(r"(?m)^## (.+)$", page)
    sections = {title: f"## {title}{text}".rstrip() for title, text in zip(parts[1::2], parts[2::2], strict=True)}
    shared = re.search(r"(?m)^Most of them have the remarks .*$", parts[0])
    return Published(rows, {title: sections[title] for title in rows}, "" if shared is None else shared[0])


def page_of(
    flights: list[Flight], runs: dict[str, Run], published: Published, arguments: argparse.Namespace, images: Path
) -> str:
    """Return the page: the table, a section for each flight with its picture and remarks, and what was not run.

    Flights without a run have what is published of them.
    """
    workspace = {flight.name: arguments.out / flight.name for flight in flights}
    kept = [flight for flight in flights if flight.name not in runs and flight.title in published.rows]
    if kept:
        shared, common = published.shared, set(re.findall(r"`([a-z0-9-]+)`", published.shared))
    else:
        common = common_remarks([remarks(figures_of(workspace[name])) for name in runs])
        shared = f"Most of them have the remarks {codes_text(Counter(sorted(common)))}." if common else ""
    rows, sections, unrun = [], [], []
    for flight in flights:
        if (run := runs.get(flight.name)) is not None:
            rows.append(row_of(flight, run, workspace[flight.name]))
            sections.append(section(flight, run, workspace[flight.name], images, common))
        elif flight in kept:
            rows.append(published.rows[flight.title])
            sections += [published.sections[flight.title], ""]
        else:
            unrun.append(f"[{flight.title}]({flight.source})")
    head = (HERE / "page.md").read_text("utf-8").format(preset=arguments.preset)
    parts = [head.rstrip("\n"), *rows, "", *([shared, ""] if shared else []), *sections]
    return "\n".join([*parts, *(["## Not run", "", f"{', '.join(unrun)}.", ""] if unrun else [])])


def section(flight: Flight, run: Run, workspace: Path, images: Path, said: Set[str] = frozenset()) -> str:
    """Return what the page says of one flight, without remarks whose codes are `said` elsewhere."""
    figures = figures_of(workspace)
    place = f"[{flight.source.removeprefix('https://github.com/')}]({flight.source})"
    place += f" at `{flight.commit[:12]}`" if flight.commit else ""
    lines = [
        f"## {flight.title}",
        "",
        f"{place}, {flight.licence}; {flight.size}. {flight.test}.",
    ]
    if "-SA" not in flight.licence and thumbnail(
        workspace / "raster/preview.png", images / f"real_{flight.name}.jpg"
    ):
        lines += ["", f"![Orthophoto of {flight.title}](images/real_{flight.name}.jpg)"]
    if run.error:
        lines += ["", f"**Failed**: {plain(run.error)}"]
    own = Counter(code for code in remarks(figures).values() if code not in said)
    lines += ["", f"Remarks: {codes_text(own)}."] if own else []
    lines += ["", f"Run with georef {run.version} on {run.hardware}, {run.at}.", ""]
    return "\n".join(lines)


def codes_text(codes: Counter[str]) -> str:
    """Return the codes of remarks with how often each was said: the flight's report has the sentences."""
    return ", ".join(f"`{code}`" + (f" ({count})" if count > 1 else "") for code, count in codes.items())


def plain(text: str) -> str:
    """Return a message without paths of this machine, as text of Markdown."""
    return (
        re.sub(r"(?:/[\w.+-]+)+/([\w.+-]+)", r"\1", text)
        .replace("|", "\\|")
        .replace("<", "&lt;")
        .replace("\n", " ")
    )


def thumbnail(preview: Path, target: Path) -> bool:
    """Write a small picture of an orthophoto on white; return whether there was one."""
    image = cv2.imread(str(preview), cv2.IMREAD_UNCHANGED) if preview.is_file() else None
    if image is None:
        return False
    if image.shape[2] == 4:
        alpha = image[..., 3:].astype(np.float32) / 255
        image = (image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
    scale = THUMBNAIL_PX / max(image.shape[:2])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    target.parent.mkdir(parents=True, exist_ok=True)
    return cv2.imwrite(str(target), small, [cv2.IMWRITE_JPEG_QUALITY, 75])


def hardware() -> str:
    """Return the processor's name and the number of cores."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text("utf-8")) if info.is_file() else []
    return f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores"


if __name__ == "__main__":
    main()
