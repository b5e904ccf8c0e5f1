"""Files of the synthetic abdomen: label map, points and a case file."""

from pathlib import Path

from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.images.abdomen import make_abdomen
from flexneedle.lab.images.markups import write_markups
from flexneedle.lab.images.volumes import write_label_map

LABELS, POINTS, CASE = "abdomen.seg.nrrd", "points.mrk.json", "case.toml"
_CASE = """\
# An insertion by an image, for flexneedle plan --image case.toml
name = "Synthetic abdomen"
scenario = "phantom3d"            # needle, motors and settings
labels = "abdomen.seg.nrrd"       # segmentation
markups = ["points.mrk.json"]
entry = "entry 1"
target = "target 1"               # or 2
skin = ["skin", "fat", "muscle", "liver", "other organs"]
registration_sd_mm = 0.3
free_radius_mm = 12.0             # the planner chooses the entry
free_slope_mrad = 180.0

[[layer]]
segments = ["skin", "fat"]
tissue = "superficial"            # of the scenario, except:
shear_modulus_kpa = 3.0

[[layer]]
segments = ["muscle"]
tissue = "superficial"
shear_modulus_kpa = 3.9

[[layer]]
segments = ["liver", "other organs"]
tissue = "deep"
shear_modulus_kpa = 2.1

[[zone]]
segment = "ribs"

[[zone]]
segment = "vessels"
"""


def write_example(folder: Path, seed: int, spacing: tuple[float, float, float]) -> list[Path]:
    """Write label map, points and case of the abdomen of a seed; return their paths.

    Raises InputError for a folder that is not empty or cannot be created, RecordError if a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(f"{folder}: already exists and is not an empty folder: choose another folder")
    except OSError as error:
        raise InputError(f"{folder}: cannot be created: {error.strerror}") from None
    made, paths = make_abdomen(seed, spacing), [folder / name for name in (LABELS, POINTS, CASE)]
    write_label_map(made.image, paths[0])
    write_markups([made.points], paths[1])
    replace_file(paths[2], _CASE.encode())
    return paths
