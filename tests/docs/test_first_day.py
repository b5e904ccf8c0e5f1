"""The commands of the page on the first day run in its order on an emulated rig."""

import re
import shlex
import subprocess
import sys

import pytest

from emulated_rig import emulated_rig, rig_file
from markdown_examples import ROOT

PAGE = (ROOT / "docs" / "rig" / "first-day.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^ {8}(flexneedle .*)$", PAGE, re.MULTILINE)
ASKS = ("home", "jog", "ready", "test", "retract", "off")


def test_the_page_has_a_step_for_each_command_of_a_rig_and_is_short():
    assert {line.split()[2] for line in COMMANDS if line.startswith("flexneedle rig")} == {
        *ASKS,
        "show",
        "check",
    }
    assert [line.split()[1] for line in COMMANDS].count("insert") == 2
    assert len(PAGE.split()) < 600


@pytest.mark.slow  # two minutes and more in real time
def test_the_commands_of_the_page_run_on_an_emulated_rig(tmp_path):
    """From the file of the rig to motors that are off, each with exit status 0."""
    path = rig_file(tmp_path)
    with emulated_rig(path, "phantom", "--seed", "4") as rig:
        text = path.read_text().replace("127.0.0.1:0", rig.ready["ready"]["galil"])
        path.write_text(f"{text}\n[loop]\ndecision_limit_s = 60.0  # a busy machine decides late\n")
        for line in COMMANDS:
            words = shlex.split(line)
            asks = words[1:2] == ["rig"] and words[2] in ASKS
            asks = asks or (words[1] == "insert" and "--dry-run" not in words)
            command = f"{shlex.quote(sys.executable)} -m {line}{' --yes' if asks else ''}"
            done = subprocess.run(
                command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False
            )
            problems = re.findall(
                r"^PROBLEM  (?!driver +reply).*$", done.stdout, re.MULTILINE
            )  # of a busy machine
            failed = problems if words[2] == "check" else done.returncode
            assert not failed, f"{line}\n{done.stdout}\n{done.stderr}"
    assert list(tmp_path.glob("runs/*-rig-test-*/axes.png"))
