"""Bundle the renderer of the page in one file: python .ci/renderer.py.

Spark on three.js, from npm at the versions that `tests.browser.chromium` names, become one script without imports,
which the package holds and each page repeats. The licences of all that is in it stand at its head. Needs npm.
"""

from __future__ import annotations

import gzip
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from pipelines.deliver.pages import RENDERER
from tests.browser.chromium import LIBRARIES

_BUNDLED = ("Three", "Spark", "Fflate")  # Spark's own file holds fflate, which unpacks
_ENTRY = """
export {
  BufferAttribute, BufferGeometry, Color, ColorManagement, Group, LinearSRGBColorSpace, LineBasicMaterial,
  LineSegments, PerspectiveCamera, Raycaster, Scene, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
"""


def bundle() -> str:
    """Return the script, which defines `Splats`; a MissingProgramError: npm cannot fetch a package."""
    folders = {name: LIBRARIES[name].folder() for name in (*_BUNDLED, "Esbuild")}
    with tempfile.TemporaryDirectory() as draft:
        entry, modules = Path(draft) / "entry.js", Path(draft) / "node_modules"
        entry.write_text(_ENTRY, "utf-8")
        for name in _BUNDLED:
            shutil.copytree(folders[name], modules / LIBRARIES[name].package)
        flags = ["--bundle", "--minify", "--format=iife", "--global-name=Splats", "--legal-comments=none"]
        program = ["node", str(folders["Esbuild"] / "bin/esbuild"), entry.name, *flags, "--log-level=warning"]
        done = subprocess.run(program, cwd=draft, check=True, capture_output=True, text=True, encoding="utf-8")
    return f"/*!\n{licences()}*/\n{done.stdout}"


def licences() -> str:
    """Return the licences of what is bundled."""
    parts = []
    for name in _BUNDLED:
        library = LIBRARIES[name]
        text = (library.folder() / "LICENSE").read_text("utf-8").strip()
        parts.append(f"{library.package} {library.version}\n\n{text}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    RENDERER.write_bytes(gzip.compress(bundle().encode(), mtime=0))
    RENDERER.with_name("renderer.LICENSE").write_text(licences(), "utf-8")
    print(f"{RENDERER}: {RENDERER.stat().st_size / 1e6:.1f} MB")
