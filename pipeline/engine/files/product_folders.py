"""Folders of results that programs leave among the photos: no picture in them is a photo."""

from __future__ import annotations

from pathlib import Path

ODM_FOLDERS = frozenset({  # docs.opendronemap.org, "OpenDroneMap Outputs"; tiles as WebODM adds them
    "odm_dem", "odm_filterpoints", "odm_georeferencing", "odm_meshing", "odm_orthophoto", "odm_report",
    "odm_texturing", "odm_texturing_25d", "opensfm", "entwine_pointcloud", "3d_tiles", "mve", "smvs", "submodels",
    "orthophoto_tiles", "dsm_tiles", "dtm_tiles",
})  # fmt: skip
RUN_MARK = Path("stages", "format.json")  # in every OUT of splatpipe


def program_of(folder: Path) -> str:
    """The program whose results a folder holds; empty for any other folder.

    OpenDroneMap's are told by their names alone, so a note names what is left out; a run of splatpipe by its mark.
    """
    if folder.name in ODM_FOLDERS:
        return "OpenDroneMap"
    return "splatpipe" if (folder / RUN_MARK).is_file() else ""
