"""Linear transforms in ITK's text files (`.tfm`), as 3D Slicer writes and reads them.

The file has the map of the parent's points to the node's, "from parent", in LPS, as ITK resamples images by it. A
transform node of 3D Slicer shows the inverse, "to parent", in RAS:
https://slicer.readthedocs.io/en/latest/developer_guide/modules/transforms.html
"""

import re
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from flexneedle.arguments import check_path, make_refusal
from flexneedle.errors import InputError
from flexneedle.files import replace_file
from flexneedle.lab.images.frames import check_matrix, swap_transform
from flexneedle.lab.images.reading import choose_suffix, reading
from flexneedle.types import Floats

SUFFIXES = (".tfm", ".txt")
_OPENING = "#Insight Transform File V1.0"
_KINDS = ("AffineTransform", "MatrixOffsetTransformBase")
_LINE = re.compile(r"(Transform|Parameters|FixedParameters):(.*)")


def read_transform(path: str | PathLike[str]) -> Floats:
    """Return the matrix (4, 4) "to parent" in RAS (mm) of an ITK file with one affine transform.

    Raises InputError for another file, several transforms, other kinds of transforms, or a matrix without inverse.
    """
    with reading(path) as file:
        choose_suffix(file, SUFFIXES)
        return _invert(swap_transform(_read_matrix(file.read_text(encoding="utf-8"))))


def write_transform(matrix: ArrayLike, path: str | PathLike[str]) -> None:
    """Write a matrix (4, 4) "to parent" in RAS (mm) to an ITK file, in one step.

    Raises InputError for another matrix or suffix, RecordError if the file cannot be written.
    """
    file = check_path("path", path)
    choose_suffix(file, SUFFIXES)
    m = swap_transform(_invert(check_matrix("transform", matrix)))
    numbers = " ".join(map(repr, [*m[:3, :3].ravel().tolist(), *m[:3, 3].tolist()]))
    text = (
        f"{_OPENING}\n#Transform 0\nTransform: AffineTransform_double_3_3\nParameters: {numbers}\n"
        "FixedParameters: 0 0 0\n"
    )
    replace_file(file, text.encode())


def _invert(matrix: Floats) -> Floats:
    inverse: Floats = np.linalg.inv(matrix).astype(float)
    return inverse


def _read_matrix(text: str) -> Floats:
    """Return the matrix (4, 4) of a file, LPS: y = M (x − c) + c + t with the fixed parameters c."""
    if not text.startswith(_OPENING):
        raise InputError(f"must begin with {_OPENING}")
    found = [match for match in map(_LINE.fullmatch, map(str.strip, text.splitlines())) if match]
    fields = {match[1]: match[2] for match in found}
    if len(found) != 3 or len(fields) != 3:
        raise InputError("must have one Transform with Parameters and FixedParameters")
    kind = fields["Transform"].strip()
    if kind not in [f"{each}_{precision}_3_3" for each in _KINDS for precision in ("double", "float")]:
        raise make_refusal("Transform", kind, f"must be {' or '.join(_KINDS)}, _double_3_3 or _float_3_3")
    numbers = _read_numbers("Parameters", fields["Parameters"], 12)
    center = _read_numbers("FixedParameters", fields["FixedParameters"], 3)
    matrix = np.eye(4)
    matrix[:3, :3] = numbers[:9].reshape(3, 3)
    matrix[:3, 3] = numbers[9:] + center - matrix[:3, :3] @ center
    return check_matrix("Parameters", matrix)


def _read_numbers(name: str, text: str, size: int) -> Floats:
    try:
        numbers = np.array(text.split(), dtype=float)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise make_refusal(name, text.strip(), f"must be {size} finite numbers")
    return numbers
