"""Entry point of `python -m georef_cli`."""

from __future__ import annotations

from georef_cli.main import main

main()
