"""Options of `ingest` that contradict each other, refused before anything is read."""

from __future__ import annotations

from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.options import flag_name
from pipelines.ingest.options import IngestOptions

_BAG_ONLY = ("image_topic", "fix_topic", "attitude_topic", "every", "origin")


def check_options(options: IngestOptions, frames: Path | None) -> None:
    """Refuse options that make no survey.

    Args:
        options: of `ingest`.
        frames: where the photographs of a bag can be written, or None.

    Raises:
        InputError: names the option.
    """
    if options.bag is not None:
        _check_bag(options, frames)
    elif given := [name for name in _BAG_ONLY if getattr(options, name) is not None]:
        raise InputError("is for a --bag, which is not given", field="--" + given[0].replace("_", "-"))
    if options.trajectory is not None and options.geo is not None:
        raise InputError("give a trajectory or a geo.txt, not both", field="--geo")
    if options.crs is not None and options.trajectory is None:
        raise InputError("is for the columns of --trajectory; other files state their CRS", field="--crs")
    if options.events is not None and (options.trajectory is None or options.lever_arm is not None):
        raise InputError(
            "is for a --trajectory of the antenna by time, and has the lever arm itself: give it with --trajectory "
            "and without --lever-arm; as positions, a .MRK is given by --trajectory",
            field="--events",
        )
    for name in ("marks", "gcp_crs"):
        if getattr(options, name) is not None and options.gcp is None and options.checkpoints is None:
            raise InputError(
                "is for ground points: give --gcp or --checkpoints", field=flag_name(IngestOptions, name)
            )
    if options.check and options.gcp is None:
        raise InputError("names points of --gcp, which is not given", field="--check")
    if options.test_every == 1:
        raise InputError("1 would leave nothing to train on: give 0, or 2 and more", field="--test-every")


def _check_bag(options: IngestOptions, frames: Path | None) -> None:
    if frames is None:
        raise InputError("a bag needs a workspace to put its photographs in", field="--bag")
    if options.crs is not None:
        raise InputError(
            "has no meaning for a --bag: its positions are latitude, longitude and ellipsoidal height, or metres "
            "in a frame whose zero --origin names",
            field="--crs",
        )
    beside = [name for name in ("images", "trajectory", "geo", "events") if getattr(options, name) is not None]
    if beside:
        raise InputError(f"has photographs and positions itself: give it without --{beside[0]}", field="--bag")
