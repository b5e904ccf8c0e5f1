"""Write the table of states in docs/safety.md from the table of the supervisor.

python tools/docs/rig_states.py
"""

from pathlib import Path

from flexneedle.lab.rig.supervisor.machine import MOVING, RigEvent, SupervisorState, next_state

PAGE = Path(__file__).parents[2] / "docs" / "safety.md"
BEGIN, END = "<!-- states -->\n", "<!-- end of states -->\n"


def table() -> str:
    """Return the table in Markdown: the state after each event, empty if it is refused."""
    heads = "|".join(str(event) for event in RigEvent)
    lines = [f"|state|{heads}|", "|---" * (1 + len(RigEvent)) + "|"]
    for state in SupervisorState:
        cells = "|".join(str(next_state(state, event) or "") for event in RigEvent)
        lines.append(f"|{f'**{state}**' if state in MOVING else state}|{cells}|")
    return "\n".join(lines) + "\n"


def page(text: str) -> str:
    """Return the page `text` with the present table."""
    before, _, rest = text.partition(BEGIN)
    _, _, after_it = rest.partition(END)
    return f"{before}{BEGIN}\n{table()}\n{END}{after_it}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
