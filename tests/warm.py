"""Imported once by the process that others are forked from: commands then begin at once."""

import flexneedle.record.recording  # noqa: F401
from flexneedle.phantom.kernels import compile_kernels

compile_kernels(1)
