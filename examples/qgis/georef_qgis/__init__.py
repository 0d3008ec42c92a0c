"""Plugin of QGIS: `georef` among the tools of Processing."""

from __future__ import annotations

from typing import Any


def classFactory(_iface: Any) -> Any:
    """Return the plugin, as QGIS asks for it."""
    from .provider import GeorefPlugin

    return GeorefPlugin()
