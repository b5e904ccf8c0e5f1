"""The README's example runs as printed."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    tip, energy, errors = capsys.readouterr().out.splitlines()
    assert 11.0 < float(tip.strip("[]").split()[0]) <= 11.5
    assert energy.endswith("True")
    assert all(float(value) < 0.5 for value in errors.split()[:2])


def test_pictures_and_links_exist() -> None:
    root = Path(__file__).parents[1]
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert targets
    assert [target for target in targets if not (root / target).exists()] == []
