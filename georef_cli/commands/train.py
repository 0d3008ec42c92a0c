"""Command `georef train`."""

from georef_cli.options import flag
from georef_cli.stage import StageCommand

command = StageCommand(
    "train",
    """Train the Gaussians together with the similarity and the cameras.

    Interrupted with Ctrl-C it writes a checkpoint, and the next `georef train` goes on from there. Options that
    would drop an interrupted training are refused without --force. A finished training is extended by more
    --iterations.

    \b
    Examples:
      georef train flight --preset fast
      georef train flight --resume
      georef train flight --iterations 4000
      georef train flight --iterations 5000 --max-image-size 800 --backend cpu
    """,
    extra=[flag("--resume", text="Continue the interrupted run; refuse other options.")],
)
