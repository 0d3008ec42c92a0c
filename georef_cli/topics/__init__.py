"""Topics of `georef help`: short texts, each a file of this package, for a terminal of 80 columns."""

from importlib import resources

# Title by name, in the order in which a new user needs them.
TOPICS = {
    "start": "from photographs to a splat on Earth",
    "workspace": "the folder of a survey, its stages, and when they run again",
    "options": "flags, georef.toml, and what is remembered",
    "presets": "effort of the training, its time and memory",
    "interrupted": "stop, continue and extend a training",
    "heights": "coordinate systems, ellipsoidal heights and geoids",
    "accuracy": "what is measured, what is predicted, and the cautions",
    "programs": "exit codes, --json and logs, for scripts",
    "completion": "completion of commands and options in the shell",
}


def topic_text(name: str) -> str:
    """Return the text of a topic of `georef help`; that of presets with the table of the training's options."""
    text = resources.files(__name__).joinpath(f"{name}.txt").read_text(encoding="utf-8")
    if name != "presets":
        return text
    from pipelines.train.options import PRESETS, RUN_MINUTES

    rows = [f"  {'':10}{'iterations':>10}{'longest side':>15}{'Gaussians':>12}{'time':>12}"]
    for preset_name, preset in PRESETS.items():
        effort = f"{preset.iterations:>10}{preset.max_image_size:>12} px{preset.max_gaussians:>12}"
        rows.append(f"  {preset_name:10}{effort}{RUN_MINUTES[preset_name]:>8} min")
    return text.replace("PRESETS", "\n".join(rows))
