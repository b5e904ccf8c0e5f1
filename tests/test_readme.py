"""The README's example runs as printed."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_example_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    plan, insertion, heads, row, state = capsys.readouterr().out.splitlines()
    off = re.fullmatch(r"<Plan manipulation to \(40, 5\) mm .* ends (\S+) mm off, .*>", plan)
    ended = re.search(r"reached: the tip ended (\S+) mm from the target>$", insertion)
    assert off is not None
    assert ended is not None
    assert all(float(found[1]) < 0.5 for found in (off, ended))
    assert heads.split() == ["time_s", "estimate_y_mm", "true_y_mm"]
    assert all(abs(float(lateral) - 5.0) < 0.5 for lateral in row.split()[2:])
    found = re.fullmatch(r"<State tip \((\S+), .* converged>", state)
    assert found is not None
    assert 11.0 < float(found[1]) <= 11.5
    assert {path.name for path in (tmp_path / "runs/first").iterdir()} >= {"run.json", "insertion.png"}
    assert (tmp_path / "insertion.png").stat().st_size > 10_000


def test_pictures_and_links_exist() -> None:
    root = Path(__file__).parents[1]
    targets = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert targets
    assert [target for target in targets if not (root / target).exists()] == []
