"""Configurations of the ablation, which the command line reads without loading a stage."""

from dataclasses import dataclass, field

from pipelines.core.errors import InputError
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import Flags

# Losses of the geographic part, of which each configuration that trains similarity and cameras adds some.
_ALONE: Flags = {"gcp_loss": False, "distance_loss": False, "geo_schedule": "constant"}
_FIXED: Flags = {**_ALONE, "georeference": "frozen", "gcp_mode": "triangulated"}
_BOTH: Flags = {**_ALONE, "gcp_loss": True, "distance_loss": True}


@dataclass(frozen=True)
class Configuration:
    """Configuration of the ablation: options of the stages.

    Attributes:
        title, note: the method in a few words; what differs from the other configurations, in one line.
        sim3: its options of `init-sim3`; None: a bundle adjustment with the fixes georeferences the model.
        train: its options of `train`; without effect if `trained_by` is set.
        trained_by: name of the configuration whose training it uses; None: its own.
    """

    name: str
    title: str
    note: str
    sim3: Flags | None
    train: Flags = field(default_factory=dict)
    trained_by: str | None = None


CONFIGURATIONS: tuple[Configuration, ...] = (
    Configuration(
        "baseline", "SfM-BBA + 3DGS",
        "bundle adjustment with the fixes as priors, then cameras fixed and no geographic loss; no control points",
        None, _FIXED,
    ),
    Configuration(
        "A", "3DGS, aligned afterwards",
        "cameras fixed as adjusted to the fixes, no geographic loss",
        {"method": "robust", "control_points": False}, _FIXED,
    ),
    Configuration(
        "B", "forward intersection + initial similarity",
        "the Gaussians of A, with the paper's similarity of the forward-intersected points",
        {"method": "paper", "control_points": False}, trained_by="A",
    ),
    Configuration(
        "C", "B + joint T and cameras, L_abs",
        "similarity and cameras trained with L_abs alone, from a robust start; no control points",
        {"method": "robust", "control_points": False}, _ALONE,
    ),
    Configuration(
        "D", "C + L_gcp + L_rel",
        "control points and relative distances too, at constant weight",
        {"method": "robust", "control_points": True}, _BOTH,
    ),
    Configuration(
        "E", "D + adaptive weight, the full method",
        "the weight of the geographic losses rises while training",
        {"method": "robust", "control_points": True}, {**_BOTH, "geo_schedule": "rising"},
    ),
)  # fmt: skip
BY_CONFIGURATION = {configuration.name: configuration for configuration in CONFIGURATIONS}
# Users cannot set the options that define the configurations. All other options of `train` hold for all of them.
COMMON_TRAIN_OPTIONS = tuple(name for name in BY_NAME["train"].options.model_fields if name not in _ALONE)


def select_configurations(text: str) -> tuple[Configuration, ...]:
    """Return the configurations named in a text with commas, each once; an InputError: an unknown name, or none."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in BY_CONFIGURATION]
    if unknown or not names:
        known = ", ".join(BY_CONFIGURATION)
        message = f"{unknown[0]!r} is none of {known}" if unknown else f"no configuration; choose from {known}"
        raise InputError("unknown-configuration", message, field="--configs")
    return tuple(BY_CONFIGURATION[name] for name in dict.fromkeys(names))
