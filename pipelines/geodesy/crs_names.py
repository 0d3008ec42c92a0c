"""Names of coordinate reference systems as people write them: read where one system has the name, else proposals.

PROJ knows the names of the EPSG register and their aliases, letter by letter. Spaces, punctuation and the word zone
do not matter here, and of UTM the zone may have the letter of its latitude band. What several systems may mean is
not read: the nearest names of PROJ's database are proposed, those first in which the points lie.
"""

import difflib
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.database import query_crs_info
from pyproj.datadir import get_data_dir
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from pipelines.core.types import FloatArray
from pipelines.geodesy.plausible import within_area

_UTM = re.compile(
    r"(?P<datum>.*?)[\s/_,-]*(?<![a-z])UTM[\s/_,-]*(?:zone)?[\s_-]*(?P<zone>\d{1,2})[\s_-]*(?P<side>north|south|[c-hj-np-x])?",
    re.IGNORECASE,
)
_WGS84 = frozenset({"wgs84", "wgs1984", "epsg4326"})
_ETRS89_ZONES = range(28, 39)
_MOST_PROPOSALS = 6
_LIKE = 0.55  # of difflib's ratio, below which names have nothing in common
_PLANE = (PJType.PROJECTED_CRS, PJType.GEOGRAPHIC_2D_CRS)


def code_of_name(name: str) -> int | None:
    """Return the EPSG code of the one system that has a name but for spaces and punctuation; None: not one."""
    utm = _UTM.fullmatch(name)
    if utm and _plain(utm["datum"]) in _WGS84 and utm["side"] and 1 <= int(utm["zone"]) <= 60:
        return (32700 if _is_south(utm["side"]) else 32600) + int(utm["zone"])
    wanted = (
        f"{utm['datum']}utm{utm['zone']}{'s' if _is_south(utm['side']) else 'n'}" if utm and utm["side"] else name
    )
    codes = [code for plain, code, _ in _register() if plain == _plain(wanted)]
    names = [code for code in codes if _plain(CRS.from_epsg(code).name) == _plain(wanted)] or codes
    return names[0] if len(set(names)) == 1 else None


def nearest_crs(name: str, points: FloatArray | None = None) -> str:
    """Return a sentence with the systems that a name may mean, with a space before it; empty: nothing is near.

    With points (N, 3), easting first, those systems alone in whose area they lie.
    """
    codes = list(dict.fromkeys([*_utm_codes(name), *_near(name)]))
    if points is not None:
        codes = [code for code in codes if _holds(code, points)]
    listed = [f"EPSG:{code} ({CRS.from_epsg(code).name})" for code in codes[:_MOST_PROPOSALS]]
    return f" Did you mean {', '.join(listed)}?" if listed else ""


def _utm_codes(name: str) -> Iterator[int]:
    utm = _UTM.fullmatch(name)
    if utm is None or not 1 <= (zone := int(utm["zone"])) <= 60:
        return
    side = (utm["side"] or "").lower()
    sides = (False, True) if side in ("", "s") else (_is_south(side),)  # S may be the band of 32° to 40° north
    for south in sides:
        if _plain(utm["datum"]) in ("", *_WGS84):
            yield (32700 if south else 32600) + zone
        if not south and zone in _ETRS89_ZONES and _plain(utm["datum"]) in ("", "etrs89", "etrs", "euref89"):
            yield 25800 + zone


def _near(name: str) -> list[int]:
    """Return codes of projected systems, the likest names first; those that have the whole name count most."""
    plain, words = _plain(name), _words(name)
    if len(plain) < 2:
        return []
    ratio: dict[int, float] = {}
    matcher = difflib.SequenceMatcher(autojunk=False)
    matcher.set_seq2(plain)
    for other, code, projected in _register():
        if not projected:
            continue
        begins = other.startswith(plain) or (len(plain) > 2 and plain in other)
        matcher.set_seq1(other)
        if not begins and (matcher.real_quick_ratio() < _LIKE or matcher.quick_ratio() < _LIKE):
            continue
        shared = len(words & _words(other)) / max(len(words), 1)
        likeness = matcher.ratio() + 0.2 * shared + (1.0 if begins else 0.0)
        if begins or likeness >= _LIKE:
            ratio[code] = max(ratio.get(code, 0.0), likeness)
    return sorted(ratio, key=lambda code: (-ratio[code], code))[:200]


def _holds(code: int, points: FloatArray) -> bool:
    """Return whether all points (N, 3) lie in the area of a system."""
    crs = CRS.from_epsg(code)
    if crs.area_of_use is None or crs.geodetic_crs is None:
        return False
    try:
        to_degrees = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
        lon, lat = map(np.asarray, to_degrees.transform(points[:, 0], points[:, 1]))
    except (CRSError, ProjError):
        return False
    if not np.isfinite(lon + lat).all():
        return False
    return bool(within_area(crs, lon, lat).all())


@cache
def _register() -> list[tuple[str, int, bool]]:
    """Return plain names of EPSG's current systems, then aliases: with the code, and whether it is projected."""
    names = []
    projected_of: dict[int, bool] = {}
    for kind in _PLANE:
        for info in query_crs_info(auth_name="EPSG", pj_types=kind):
            projected_of[int(info.code)] = kind is PJType.PROJECTED_CRS
            names.append((info.name, int(info.code)))
    database = Path(get_data_dir()) / "proj.db"
    if database.is_file():
        query = (
            "select alt_name, code from alias_name where auth_name = 'EPSG' and table_name in "
            "('projected_crs', 'geodetic_crs')"
        )
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?immutable=1", uri=True)) as connection:
            names += [(name, int(code)) for name, code in connection.execute(query) if int(code) in projected_of]
    return [(_plain(name), code, projected_of[code]) for name, code in names]


def _plain(name: str) -> str:
    return re.sub(r"zone|[\W_]", "", name.casefold())


def _words(name: str) -> set[str]:
    return set(re.findall(r"[^\W\d_]+|\d+", name.casefold()))


def _is_south(side: str) -> bool:
    return side.lower() in ("south", "s") or side.lower() in "cdefghjklm"
