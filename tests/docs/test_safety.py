"""The page about safety has the table of states that the supervisor runs from."""

from rig_states import PAGE, page


def test_the_page_has_the_present_table_of_states():
    text = PAGE.read_text(encoding="utf-8")
    assert page(text) == text
