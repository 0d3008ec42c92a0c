"""Names of columns as programs and people write them: which of them mean one thing, in which unit, and near misses.

A reader of a kind of table states its vocabulary: the meaning of each plain name. Case, separators, brackets, units
and what measured (`gps_height`, `CameraLatitude [deg]`) do not matter. The names are those of OpenDroneMap, PIX4D,
Metashape, RealityCapture, Emlid, Propeller, Trimble and ExifTool, and of tables in public repositories.
"""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence

_LONGEST_NAME = 100  # of a column that means something
_BRACKETS = re.compile(r"[(\[]([^)\]]*)[)\]]")

# What measured a coordinate or holds it: before or after its name.
_MEASURED_BY = (
    "gps", "gnss", "rtk", "ppk", "ins", "imu", "antenna", "camera", "cam", "uav", "drone", "exif", "xmp",
    "position", "pos", "wgs84", "geo", "map", "measured", "center", "centre", "utm", "decimal", "dd",
)  # fmt: skip
# Angles are not among these: the yaw of the drone is not the camera's.
_COORDINATES = frozenset(
    {"latitude", "longitude", "altitude", "ellipsoidal", "orthometric", "relative", "x", "y", "z"}
)

# Factors to metres and to degrees, by the plain name of the unit.
LENGTHS_M = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "feet", "foot", "ift", "ftint", "intft", "internationalfeet"), 0.3048),
    **dict.fromkeys(("usft", "ftus", "usfeet", "ussft", "sft", "ussurveyfoot", "ussurveyfeet"), 1200.0 / 3937.0),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("km", "kilometre", "kilometer"), 1000.0),
}
ANGLES_DEG = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "dd", "decimaldegrees"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), 57.29577951308232),
    **dict.fromkeys(("gon", "gons", "grad", "grads", "gradian", "gradians"), 0.9),
}
_UNITS = LENGTHS_M | ANGLES_DEG | dict.fromkeys(("px", "pix", "pixel", "pixels", "s", "sec", "seconds"), 1.0)


def _named(meanings: Mapping[str, Iterable[str]]) -> dict[str, str]:
    return {name: meaning for meaning, names in meanings.items() for name in (meaning.replace("_", ""), *names)}


# Coordinates of cameras and of surveyed points. Heights are of several kinds, which are not mixed.
COORDINATES = _named(
    {
        "latitude": ("lat", "ylatitude", "latitudey"),
        "longitude": ("lon", "lng", "long", "xlongitude", "longitudex"),
        "altitude": (
            "alt", "height", "h", "zaltitude", "altitudez", "zheight", "altitudeabsolute", "absolutealtitude",
            "altitudeabs", "absalt", "absaltitude", "altabs", "up",
        ),
        "z": ("elevation", "ele", "elev", "zelevation", "zcoordinate", "coordz", "zcoord"),
        "ellipsoidal": (
            "ellipsoidalheight", "ellipsoidheight", "heightellipsoidal", "heightellipsoid",
            "ellipsoidalelevation", "ellipsoidalaltitude", "altitudeellipsoidal", "altitudeellipsoid", "ellh",
            "hell", "ellheight", "ellipheight", "hae", "heightaboveellipsoid", "altitudehae", "altitudewgs84",
            "heightwgs84", "wgs84height", "wgs84altitude",
        ),
        "orthometric": (
            "orthometricheight", "orthometricelevation", "orthoheight", "heightorthometric", "altitudeorthometric",
            "msl", "altitudemsl", "heightmsl", "elevationmsl", "mslaltitude", "mslheight", "amsl", "altitudeamsl",
            "heightabovegeoid", "heightabovemsl", "meansealevel",
        ),
        "relative": (
            "relativealtitude", "altituderelative", "relalt", "altrel", "relaltitude", "relativeheight",
            "heightrelative", "agl", "altitudeagl", "heightagl", "heightabovetakeoff", "altitudeabovetakeoff",
            "heightaboveground", "altitudeaboveground", "heightabovegroundlevel",
        ),
        "latitude_ref": ("latref", "gpslatituderef", "latitudehemisphere", "ns", "northsouth"),
        "longitude_ref": ("lonref", "longref", "gpslongituderef", "longitudehemisphere", "ew", "eastwest"),
        "altitude_ref": ("altref", "gpsaltituderef"),
        "x": ("easting", "east", "e", "xeasting", "eastingx", "xeast", "eastx", "xcoordinate", "coordx", "xcoord"),
        "y": (
            "northing", "north", "n", "ynorthing", "northingy", "ynorth", "northy", "ycoordinate",
            "coordy", "ycoord",
        ),
    }
)  # fmt: skip
_OF_EAST, _OF_NORTH, _OF_UP = ("e", "east", "easting", "x"), ("n", "north", "northing", "y"), (
    "u", "up", "z", "altitude", "elevation", "height",
)  # fmt: skip
_ACCURACIES = ("sigma", "std", "sd", "stddev", "accuracy", "acc", "rms", "rmse", "precision", "uncertainty", "s")


def _accuracies(axes: Iterable[str]) -> tuple[str, ...]:
    # `acc_x` is an acceleration, and `s` alone before a letter a σ.
    pairs = [
        (word, axis) for word in _ACCURACIES for axis in axes if (word, len(axis)) != ("acc", 1) or axis in "hv"
    ]
    return tuple(
        name for word, axis in pairs for name in (word + axis, axis + word) if len(name) > 2 or name[0] == "s"
    )


ACCURACIES = _named(
    {
        "sigma_e": _accuracies(_OF_EAST),
        "sigma_n": _accuracies(_OF_NORTH),
        "sigma_u": _accuracies(_OF_UP),
        "sigma_h": _accuracies(("h", "horz", "hor", "horizontal", "lateral", "xy", "2d", "plan")),
        "sigma_v": _accuracies(("v", "vert", "ver", "vertical")),
    }
)
ANGLES = _named(
    {
        "yaw": ("heading", "gimbalyaw", "gimbalyawdegree", "gimbalheading", "camerayaw", "camyaw", "cameraheading"),
        "pitch": ("gimbalpitch", "gimbalpitchdegree", "camerapitch", "campitch"),
        "roll": ("gimbalroll", "gimbalrolldegree", "cameraroll", "camroll"),
        "omega": ("omegax",),
        "phi": ("phiy",),
        "kappa": ("kappaz",),
        **dict.fromkeys(("qx", "qy", "qz", "qw"), ()),
    }
)
IMAGES = _named(
    {
        "image": (
            "imagename", "imagefile", "imagefilename", "imagepath", "imagelabel", "imageid", "img", "imgname",
            "imgfile", "imgfilename", "filename", "file", "filepath", "path", "sourcefile", "photo", "photoname",
            "photofile", "photoid", "photofilename", "picture", "picturename", "cameralabel", "cameraname",
            "camera", "frame", "framename", "jpg", "rgbname", "rasterid",
        )
    }
)  # fmt: skip
POINTS = _named(
    {
        "label": (
            "name", "id", "point", "pointname", "pointid", "pointnumber", "pointno", "pt", "ptid", "ptname",
            "gcp", "gcplabel", "gcpname", "gcpid", "target", "targetname", "targetid", "targetlabel", "marker",
            "markername", "markerid", "markerlabel", "controlpoint", "controlpointname", "station", "tag",
            "tagid",
        )
    }
)  # fmt: skip
# Words of other languages: for proposals alone, since one word may mean two things (Breite: latitude, width).
_TRANSLATED = {
    "bild": "image", "bildname": "image", "foto": "image", "datei": "image", "fichier": "image",
    "archivo": "image", "imagen": "image", "immagine": "image", "zdjecie": "image", "breite": "latitude",
    "breitengrad": "latitude", "szerokosc": "latitude", "laenge": "longitude", "länge": "longitude",
    "laengengrad": "longitude", "längengrad": "longitude", "dlugosc": "longitude", "hoehe": "altitude",
    "höhe": "altitude", "hauteur": "altitude", "altura": "altitude", "quota": "altitude", "wysokosc": "altitude",
    "cota": "altitude", "rechtswert": "x", "ostwert": "x", "este": "x", "est": "x", "hochwert": "y",
    "nordwert": "y", "norte": "y", "nord": "y", "punkt": "label", "punktname": "label", "punktnummer": "label",
    "punto": "label", "zeit": "timestamp",
}  # fmt: skip


def plain_name(text: str) -> str:
    """Return a name without what does not matter: case, text in brackets, and all that is no letter or digit."""
    return re.sub(r"[\W_]", "", _BRACKETS.sub("", text[:_LONGEST_NAME]).casefold())


def meaning_of(text: str, vocabulary: Mapping[str, str]) -> str | None:
    """Return the meaning of a column's name; None: it means nothing here.

    The name itself counts first, then the name without its unit, then without what measured it. A unit or a word
    in brackets that is a name of its own (`height (ellipsoidal)`) counts as a part of the name.
    """
    plain = plain_name(text)
    for note in _BRACKETS.findall(text[:_LONGEST_NAME]):
        if (whole := vocabulary.get(plain + plain_name(note))) is not None:
            return whole
    for name in (plain, _without_unit(text)):
        if name in vocabulary:
            return vocabulary[name]
        for bare in _without_measurer(name):
            if vocabulary.get(bare) in _COORDINATES:
                return vocabulary[bare]
    return None


def unit_of(text: str) -> str | None:
    """Return the plain unit that a column's name states, in brackets or as its last word; None: it states none."""
    notes = [plain_name(note) or note.strip() for note in _BRACKETS.findall(text[:_LONGEST_NAME])]
    return next((note for note in (*notes, *_words(text)[1:][-1:]) if note in _UNITS), None)


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\W_]+", _BRACKETS.sub(" ", text[:_LONGEST_NAME]).casefold()) if word]


def _without_unit(text: str) -> str:
    words = _words(text)
    return "".join(words[:-1] if len(words) > 1 and words[-1] in _UNITS else words)


def _without_measurer(name: str) -> list[str]:
    before = [name.removeprefix(word) for word in _MEASURED_BY if name.startswith(word)]
    after = [name.removesuffix(word) for word in _MEASURED_BY if name.endswith(word)]
    return [bare for bare in (*before, *after) if bare]


def nearest_columns(header: Sequence[str], vocabulary: Mapping[str, str]) -> str:
    """Return what the columns `header` may mean, as a sentence with a space before it; empty: nothing is near."""
    near = []
    for text in header:
        plain = plain_name(text)
        if not plain or meaning_of(text, vocabulary) is not None:
            continue
        close = difflib.get_close_matches(plain, [name for name in vocabulary if len(name) > 2], 1, 0.7)
        meaning = _TRANSLATED.get(plain) or (vocabulary[close[0]] if close else None)
        if meaning in vocabulary.values():
            near.append(f"{text.strip()[:40]} is {meaning}")
    return f" Perhaps {', '.join(near[:12])}: rename the columns." if near else ""


def listed_columns(header: Sequence[str]) -> str:
    """Return the names of columns for a message."""
    return ", ".join(text.strip()[:40] or "(unnamed)" for text in header[:20]) + (" …" if len(header) > 20 else "")
