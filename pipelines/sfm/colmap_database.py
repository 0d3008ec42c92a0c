"""COLMAP's database of a survey or a part of it: cameras and images, and copies of features and matches.

An image has the same number in every database of a survey: its place in the survey, counted from 1. Rows of
features and matches are therefore copied as they are. COLMAP's own `Database.merge` renumbers images and refuses
databases that share one, as those of matches do.
"""

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path
from types import ModuleType

import numpy as np

from pipelines.core.errors import DamagedPartialError, InputError, storage_error
from pipelines.core.files import remove, replace_file
from pipelines.core.stages import SURVEY
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import ColmapCamera, ColmapDatabase
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import CameraPrior, Survey

FEATURES = ("keypoints", "descriptors")
MATCHES = ("matches", "two_view_geometries")


def write_frame(
    colmap: ModuleType, database: Path, survey: Survey, images: Iterable[int], options: SfmOptions
) -> None:
    """Write cameras and images (indices into the survey's) into a database, made if missing; present ones stay.

    Raises:
        InputError: a camera prior is none of COLMAP's cameras.
    """
    priors = {prior.camera_id: prior for prior in survey.cameras}
    with colmap.Database.open(database) as opened, colmap.DatabaseTransaction(opened):
        known = {image.image_id for image in opened.read_all_images()}
        for index in images:
            image_id = index + 1
            if image_id in known:
                continue
            image = survey.images[index]
            if not opened.exists_camera(image.camera_id):
                _write_camera(colmap, opened, priors[image.camera_id], options)
            row = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=image_id)
            opened.write_image(row, use_image_id=True)
            frame = colmap.Frame(frame_id=image_id, rig_id=image.camera_id)
            frame.add_data_id(row.data_id)
            opened.write_frame(frame, use_frame_id=True)


def rename_images(colmap: ModuleType, path: Path, names: dict[str, str]) -> None:
    """Rename those images of a database whose names are keys of `names`."""
    with colmap.Database.open(path) as database, colmap.DatabaseTransaction(database):
        for image in database.read_all_images():
            if image.name in names:
                image.name = names[image.name]
                database.update_image(image)


def copy_rows(
    source: Path, target: Path, tables: Iterable[str], images: Iterable[int] | None = None, *, shift: int = 0
) -> None:
    """Copy rows of features or matches from a finished database of a survey into another; present rows stay.

    `tables` are `FEATURES` or `MATCHES`, `images` indices of those whose features are copied; None: all rows. The
    images of features get numbers that are larger by `shift`.

    Raises:
        DamagedPartialError: the source is no whole database, or one of another version of COLMAP.
        sqlite3.Error: the target cannot be written.
    """
    with closing(sqlite3.connect(target, isolation_level=None, uri=True)) as connection:
        try:
            # Immutable: a finished database needs no lock, which network file systems may not grant.
            connection.execute("attach database ? as source", (f"{source.absolute().as_uri()}?immutable=1",))
            versions = {connection.execute(f"pragma {name}.user_version").fetchone() for name in ("main", "source")}
            if len(versions) > 1:
                raise DamagedPartialError("colmap-version", "was made by another version of COLMAP.", path=source)
            connection.execute("begin immediate")
            wanted = "" if images is None else "where image_id in (select image_id from temp.wanted)"
            if images is not None:
                connection.execute("create temp table wanted (image_id integer primary key)")
                connection.executemany("insert into wanted values (?)", ((index + 1,) for index in images))
            for table in tables:
                columns = [row[1] for row in connection.execute(f"pragma source.table_info({table})")]
                values = [f"{name} + {shift}" if name == "image_id" else name for name in columns]
                chosen = f"select {', '.join(values)} from source.{table} {wanted}"
                connection.execute(f"insert or ignore into main.{table} ({', '.join(columns)}) {chosen}")
            connection.execute("commit")
        except sqlite3.DatabaseError as error:
            if storage_error(error) is not None:
                raise
            raise DamagedPartialError("database-damaged", f"cannot be copied: {error}", path=source) from error


def copy_database(source: Path, target: Path) -> None:
    """Copy a whole database, which another process may have open."""
    with closing(sqlite3.connect(source)) as original, closing(sqlite3.connect(target)) as copy:
        original.backup(copy)


def add_features(
    colmap: ModuleType,
    path: Path,
    places: Mapping[int, FloatArray],
    matches: Mapping[tuple[int, int], IntArray],
) -> None:
    """Add features without SIFT's descriptors, and their matches, to those in a database.

    Pairs with new matches lose their verified ones: they wait to be verified again, old and new matches together.

    Args:
        places: (N, 2) pixels of the whole photograph, by the photograph's index in the survey.
        matches: (M, 2) rows of `places` of each pair of indices.
    """
    with colmap.Database.open(path) as database, colmap.DatabaseTransaction(database):
        begin = {}
        for index, xy_px in places.items():
            known = np.asarray(database.read_keypoints(index + 1), dtype=np.float32)
            columns = known.shape[1] if known.size else 2
            # Beside the place COLMAP keeps the shape: scale and orientation, or an affine matrix.
            shape = {2: (), 4: (1.0, 0.0), 6: (1.0, 0.0, 0.0, 1.0)}[columns]
            new = np.concatenate([xy_px, np.tile(np.array(shape), (len(xy_px), 1))], axis=1).astype(np.float32)
            begin[index] = len(known)
            database.update_keypoints(index + 1, np.concatenate([known.reshape(-1, columns), new]))
        shifted = {(a, b): np.add(rows, (begin[a], begin[b])) for (a, b), rows in matches.items()}
        _write_matches(database, shifted)


def add_matches(colmap: ModuleType, path: Path, matches: Mapping[tuple[int, int], IntArray]) -> None:
    """Add matches of features to those in a database; pairs that get some wait to be verified again.

    `matches` are rows (M, 2) of the features of each pair of the photographs' indices in the survey.
    """
    with colmap.Database.open(path) as database, colmap.DatabaseTransaction(database):
        _write_matches(database, matches)


def _write_matches(database: ColmapDatabase, matches: Mapping[tuple[int, int], IntArray]) -> None:
    for (a, b), rows in matches.items():
        before = np.zeros((0, 2), dtype=np.uint32)
        if database.exists_matches(a + 1, b + 1):
            before = np.asarray(database.read_matches(a + 1, b + 1), dtype=np.uint32).reshape(-1, 2)
            database.delete_matches(a + 1, b + 1)
        if database.exists_two_view_geometry(a + 1, b + 1):
            database.delete_two_view_geometry(a + 1, b + 1)
        both = np.concatenate([before, np.asarray(rows, dtype=np.uint32)])
        _, kept = np.unique(both, axis=0, return_index=True)
        database.write_matches(a + 1, b + 1, both[np.sort(kept)])


def has_added_features(colmap: ModuleType, path: Path) -> bool:
    """Return whether a photograph of a database has features that `add_features` has added."""
    with colmap.Database.open(path) as database:
        return bool(database.num_keypoints() > database.num_descriptors())


def drop_added_features(path: Path) -> None:
    """Drop from a database what `add_features` has added to the keypoints: features without SIFT's descriptors."""
    with closing(sqlite3.connect(path)) as connection, connection:
        known = "(select rows from descriptors where descriptors.image_id = keypoints.image_id)"
        connection.execute(
            f"update keypoints set data = substr(data, 1, 4 * cols * {known}), rows = {known} where rows > {known}"
        )


def verified_matches(colmap: ModuleType, path: Path) -> dict[tuple[int, int], int]:
    """Return the numbers of verified matches of the pairs of a database: indices i < j of the survey's images."""
    matches = {}
    with colmap.Database.open(path) as database:
        for pair, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            first, second = sorted(colmap.pair_id_to_image_pair(pair))
            matches[first - 1, second - 1] = int(count)
    return matches


def finish_database(draft: Path, final: Path, *, without: Iterable[str] = ()) -> None:
    """Make a draft the final database, a single file, and delete the rows of the tables in `without`."""
    with closing(sqlite3.connect(draft, isolation_level=None)) as connection:
        for table in without:
            connection.execute(f"delete from {table}")
        connection.execute("pragma journal_mode = delete")  # COLMAP's journal is a second file.
        connection.execute("vacuum")
    replace_file(draft, final)


def remove_database(path: Path) -> None:
    """Remove a database of SQLite, if it exists, with what its journals hold."""
    for suffix in ("", "-wal", "-shm", "-journal"):
        remove(path.with_name(path.name + suffix))


def require_sound(database: Path) -> None:
    """Refuse a damaged database of an interrupted run; COLMAP would crash, or continue without a part of it.

    Raises:
        DamagedPartialError: SQLite finds the file damaged.
    """
    if not database.exists():
        return
    try:
        with closing(sqlite3.connect(database)) as connection:
            (verdict,) = connection.execute("pragma quick_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        if storage_error(error) is not None:
            raise
        verdict = str(error)
    if verdict != "ok":
        raise DamagedPartialError("database-damaged", f"The database is damaged: {verdict}", path=database)


def _write_camera(colmap: ModuleType, database: ColmapDatabase, prior: CameraPrior, options: SfmOptions) -> None:
    """Write a camera, and the rig that consists of it alone and has its number."""
    # No perspective model approximates a fisheye: its own model is kept.
    model = prior.model if prior.model == "OPENCV_FISHEYE" else options.camera_model
    camera = colmap.Camera.create_from_model_name(
        prior.camera_id, model, prior.params[0], prior.width, prior.height
    )
    _copy_shared_params(colmap, prior, camera)
    camera.has_prior_focal_length = prior.focal_source != "assumed"
    database.write_camera(camera, use_camera_id=True)
    rig = colmap.Rig(rig_id=prior.camera_id)
    rig.add_ref_sensor(camera.sensor_id)
    database.write_rig(rig, use_rig_id=True)


def _copy_shared_params(colmap: ModuleType, prior: CameraPrior, camera: ColmapCamera) -> None:
    try:
        original = colmap.Camera(
            model=prior.model, width=prior.width, height=prior.height, params=list(prior.params)
        )
        names = [name.strip() for name in original.params_info.split(",")]
        by_name = dict(zip(names, prior.params, strict=True))
    except ValueError as error:
        raise InputError(
            "unknown-camera-model",
            f"{prior.model} with {len(prior.params)} parameters is not a camera model of COLMAP.",
            field=SURVEY,
        ) from error
    f = by_name.get("f", by_name.get("fx", 0.0))
    by_name = {"f": f, "fx": f, "fy": f, "k": by_name.get("k1", 0.0), "k1": by_name.get("k", 0.0), **by_name}
    params = camera.params
    for index, name in enumerate(part.strip() for part in camera.params_info.split(",")):
        params[index] = by_name.get(name, params[index])
    camera.params = params
