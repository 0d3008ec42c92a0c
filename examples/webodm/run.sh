#!/bin/sh
# Called by NodeODM: run.sh --project-path FOLDER [--OPTION VALUE] ... TASK
# Python is that of venv/ in this folder, into which georefgs is installed, or what GEOREF_PYTHON names, or python3.
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd) || exit 3
python=${GEOREF_PYTHON:-python3}
if [ -x "$here/venv/bin/python" ]; then
    python=$here/venv/bin/python
fi
if ! command -v "$python" >/dev/null; then
    echo "[ERROR]   There is no $python: install georefgs into $here/venv, or let GEOREF_PYTHON name its Python." >&2
    exit 3 # which NodeODM shows as an installation issue
fi
exec "$python" "$here/engine.py" "$@"
