"""Entry point of `python -m georef_cli`.

`python -m` looks for modules in the current folder first, and photographs may have a `queue.py` beside them. That
folder is therefore left out before anything else is imported; a checkout is needed, and comes last. What Python has
imported before the first line is out of reach: `georef` and `python -P -m georef_cli` are safe from the start.
"""

import sys

current = "" if sys.flags.safe_path else sys.path.pop(0)

from pathlib import Path  # noqa: E402

if current == str(Path(__file__).parents[1]):
    sys.path.append(current)

from georef_cli.main import main  # noqa: E402

main()
