"""The option `--backend`, checked before any stage begins; imports no torch."""

from typing import Annotated, Literal

from pipelines.core.options import NeedMarker


def _require(name: str) -> None:
    if name == "cuda":  # `auto` takes what there is
        from pipelines.splat.rasterizer.backends import chosen_backend

        chosen_backend("cuda")


Backend = Annotated[Literal["auto", "cpu", "cuda"], NeedMarker(_require)]
