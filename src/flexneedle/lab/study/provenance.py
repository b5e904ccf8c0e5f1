"""The code of a study, versions and files of custom modules, compared in each process that computes for it."""

import os
import pickle
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flexneedle.errors import InputError, RunError, ScenarioWarning, make_printable
from flexneedle.module_files import digest_files
from flexneedle.record.folder import versions

if TYPE_CHECKING:
    from flexneedle.lab.study.grid import ExpandedStudy

Modules = dict[str, dict[str, str]]
REMEDY = "give the worker the same code and restart it"


@dataclass(frozen=True)
class StudyCode:
    """versions: of packages; modules: digests of the files of custom modules, by module and file."""

    versions: dict[str, str]
    modules: Modules

    @classmethod
    def of(cls, study: "ExpandedStudy") -> "StudyCode":
        """Return the code of a study as it is recorded."""
        return cls(versions(), study.definition["own"])

    def check(self, on_cluster: bool) -> None:
        """Raise InputError if a file has changed since it was loaded or, on a cluster, has no source."""
        present = {name: digest_files(name, as_loaded=False) for name in self.modules}
        if changed := compare_modules(self.modules, present, "as loaded", "now"):
            raise InputError(f"{changed}: restart Python or the notebook's kernel")
        for module, files in self.modules.items():
            for file in (name for name in files if not files[name]):
                about = make_printable(f"module {module}: {file} has no source")
                if on_cluster:
                    raise InputError(
                        f"{about} to compare with the workers': run the study without a scheduler"
                    )
                warnings.warn(f"{about}; its changes are not noticed", ScenarioWarning, stacklevel=3)


def compare_modules(
    before: Modules, after: Modules, first: str = "in the folder", second: str = "now"
) -> str:
    """Return the first file that differs, in one line, or "". first, second: places or times of the two."""
    for module in before | after:
        old, new = before.get(module, {}), after.get(module, {})
        for file in old | new:
            if old.get(file) != new.get(file):
                digests = f"{_format_digest(old, file)} {first}, {_format_digest(new, file)} {second}"
                return make_printable(f"module {module}: {file} is {digests}")
    return ""


def _format_digest(files: Mapping[str, str], file: str) -> str:
    return (files[file] or "without source") if file in files else "missing"


def find_difference(code: StudyCode) -> str:
    """Return the first difference between this process and the code of a study, in one line, or ""."""
    present = versions()
    for name in code.versions | present:
        there, here = present.get(name, "missing"), code.versions.get(name, "missing")
        if there != here:
            return f"version of {name} is {there} there, {here} here: {REMEDY}"
    files = {name: digest_files(name) for name in code.modules}
    changed = compare_modules(files, code.modules, "there", "here")
    return f"{changed}: {REMEDY}" if changed else ""


def run_checked(code: StudyCode, function: Callable[[Any], Any], argument: bytes) -> Any:
    """Return `function(argument)` if this process has the code of the study; else raise RunError.

    The argument is unpickled after the check, since this loads custom modules.
    """
    if difference := find_difference(code):
        raise RunError(f"worker {_name_process()}: {difference}")
    return function(pickle.loads(argument))


def _name_process() -> str:
    """Return the address of a Dask worker, or the number of a local process."""
    if "distributed" in sys.modules:
        from distributed import get_worker

        try:
            return str(get_worker().address)
        except ValueError:  # in no worker
            pass
    return f"process {os.getpid()}"
