"""Write docs/reference/case.md from the model of case files.

python tools/docs/case_reference.py
"""

from pathlib import Path
from typing import Any

from flexneedle.lab.images.case_file import ImageCase
from scenario_reference import heading, section, tables, wrap

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "case.md"
_ADVICE: dict[str, Any] = {"sections": {}, "keys": {}}
_INTRODUCTION = """\
# Case files

A case file (TOML) describes an insertion by an image, for `flexneedle plan --image case.toml`, `insert` and `serve`
([how to](../how-to/slicer.md)). A relative path is from the folder of the file. Unknown keys are refused.
"""


def page() -> str:
    """Return the page, Markdown."""
    shown = (section(table, heading(table), _ADVICE) for table in tables(ImageCase.model_json_schema()))
    return wrap(_INTRODUCTION, "\n".join(shown))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
