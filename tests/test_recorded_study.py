"""studies/recorded.py: both halves of each session, and the part of the page that it writes."""

import pytest

import recorded
import validation
from simulated_session import simulate


@pytest.mark.long
def test_each_half_predicts_the_other_and_the_part_of_the_page_is_replaced(tmp_path, capsys):
    simulate(4, names=("a", "b"), resting=2, seed=3, steps=15).save(tmp_path / "session")
    page = tmp_path / "validation.md"
    page.write_text(f"# Validation\n\nBefore.\n{validation.RECORDED}\n\nOld.\n")
    recorded.main([str(tmp_path / "session"), "gel", "--fit", "stiffness", "bevel", "--out", str(tmp_path)])
    before, part = page.read_text().split("\n## Against recordings\n")
    assert before == "# Validation\n\nBefore.\n"
    assert "Old." not in part
    assert "8 insertions of 2 sessions" in part.replace("\n", " ")
    rows = [line.split("|")[1] for line in part.splitlines() if line.startswith(("|a,", "|b,"))]
    assert rows == ["a, even", "a, odd", "b, even", "b, odd"]
    assert (tmp_path / "images" / "recordings-errors.png").stat().st_size > 1000
    assert f"{tmp_path / 'images' / 'recordings-errors.png'}\n" in capsys.readouterr().out
