"""What pyproject.toml cannot say: a package holds the commit that it was made from (`georef --version`)."""

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from pipelines.core.version import PACKED, described_commit  # noqa: E402


def pack_commit(folder: Path) -> None:
    """Write the commit into a copy of the packages; a source package has it already."""
    commit = described_commit(HERE)
    if commit is not None:
        (folder / PACKED).write_text(commit + "\n", encoding="utf-8")


class BuildWithCommit(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            pack_commit(Path(self.build_lib))


class SourceWithCommit(sdist):
    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        pack_commit(Path(base_dir))


setup(cmdclass={"build_py": BuildWithCommit, "sdist": SourceWithCommit})
