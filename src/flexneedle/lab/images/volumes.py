"""Readers and writers of label maps by the suffix of the file."""

from os import PathLike

from flexneedle.arguments import check_path, require_extra
from flexneedle.files import replace_file
from flexneedle.lab.images.label_map import LabelMap
from flexneedle.lab.images.nifti_files import encode_nifti, read_nifti
from flexneedle.lab.images.nrrd_files import encode_nrrd, read_nrrd
from flexneedle.lab.images.reading import choose_suffix, reading

_NIFTI = (".nii", ".nii.gz")
READ = (".seg.nrrd", ".nrrd", ".nhdr", *_NIFTI)
WRITTEN = (".seg.nrrd", *_NIFTI)


def read_label_map(path: str | PathLike[str]) -> LabelMap:
    """Return the label map of a file with a suffix in `READ`, in RAS (mm).

    NRRD is LPS or RAS by its header, NIfTI is RAS. Raises InputError, one line, for a file that is damaged, has no
    space, unit or affine that is certain, or has segments that contradict its voxels.
    """
    require_extra("images", "nibabel", "nrrd")
    with reading(path) as file:
        return read_nifti(file) if choose_suffix(file, READ) in _NIFTI else read_nrrd(file)


def write_label_map(image: LabelMap, path: str | PathLike[str]) -> None:
    """Write a label map to a file with a suffix in `WRITTEN`, in one step.

    `.seg.nrrd` has all layers and names, in LPS; NIfTI has one layer without names, and an affine in single precision.
    Raises InputError for another suffix or several layers in NIfTI, RecordError if the file cannot be written.
    """
    require_extra("images", "nibabel", "nrrd")
    file = check_path("path", path)
    suffix = choose_suffix(file, WRITTEN)
    data = encode_nifti(image, zipped=suffix == ".nii.gz") if suffix in _NIFTI else encode_nrrd(image)
    replace_file(file, data)
