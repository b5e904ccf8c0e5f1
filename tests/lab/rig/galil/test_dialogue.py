"""Commands and queries of the dialogue with a controller, on a link in memory."""

import pytest

from flexneedle.errors import DriverError
from flexneedle.lab.rig.devices.galil.dialogue import Dialogue
from flexneedle.lab.rig.devices.galil.replies import Reply


class Refusing:
    """A link to a controller that refuses all but the query for the reason."""

    name = "lab"

    def ask(self, commands, _deadline):
        return tuple(
            Reply(True, "1 Unrecognized command\r\n") if one == "TC1" else Reply(False) for one in commands
        )


def test_control_characters_of_a_refused_query_are_printed():
    with pytest.raises(DriverError) as refused:
        Dialogue(Refusing()).text("\x12\x16", 0.0)
    assert str(refused.value) == "lab: ^R^V refused: 1 Unrecognized command"
