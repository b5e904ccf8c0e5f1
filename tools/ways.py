"""Count the files, hops and processes through which records pass while a command runs.

python tools/ways.py Scenario,Plan,Period,Insertion -- flexneedle insert phantom --seed 0 --out /tmp/run

A hop is a call from one file of the package to another with a record of a named type among its arguments, or first in a
list or tuple among them; each pair of files counts once. Child processes count, too.
"""

import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import FrameType

_TYPES, _FOLDER = "FLEXNEEDLE_WAYS_TYPES", "FLEXNEEDLE_WAYS_FOLDER"
_PACKAGE = f"{os.sep}flexneedle{os.sep}"


def watch() -> None:
    """Append each hop that is new in this process to a file of this process."""
    types, seen = set(os.environ[_TYPES].split(",")), set[tuple[str, str]]()

    def is_record(value: object) -> bool:
        if isinstance(value, tuple | list) and type(value).__module__ == "builtins" and value:
            value = value[0]
        return type(value).__name__ in types and type(value).__module__.startswith("flexneedle")

    def on_call(frame: FrameType, event: str, _: object) -> None:
        if event != "call" or _PACKAGE not in frame.f_code.co_filename:
            return
        caller = frame.f_back
        while caller and _PACKAGE not in caller.f_code.co_filename:
            caller = caller.f_back
        if caller is None or caller.f_code.co_filename == frame.f_code.co_filename:
            return
        hop = (caller.f_code.co_filename, frame.f_code.co_filename)
        if hop not in seen and any(map(is_record, list(frame.f_locals.values()))):
            seen.add(hop)
            with (Path(os.environ[_FOLDER]) / str(os.getpid())).open("a") as file:
                file.write("\t".join(path.split(_PACKAGE)[-1] for path in hop) + "\n")

    threading.setprofile(on_call)
    sys.setprofile(on_call)


def main() -> int:
    """Run the command, print hops, and their count."""
    types, _, *command = sys.argv[1:]
    with tempfile.TemporaryDirectory() as hook, tempfile.TemporaryDirectory() as folder:
        (Path(hook) / "sitecustomize.py").write_text("import ways\nways.watch()\n")
        paths = (hook, str(Path(__file__).parent), os.environ.get("PYTHONPATH", ""))
        environment = {
            **os.environ,
            _TYPES: types,
            _FOLDER: folder,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        }
        status = subprocess.run(command, env=environment, check=False).returncode
        processes = [file.read_text().splitlines() for file in Path(folder).iterdir()]
    hops = sorted({line for lines in processes for line in lines})
    print(*(line.replace("\t", " → ") for line in hops), sep="\n")
    files = {file for line in hops for file in line.split("\t")}
    print(f"{len(files)} files, {len(hops)} hops, {len(processes)} processes")
    return status


if __name__ == "__main__":
    sys.exit(main())
