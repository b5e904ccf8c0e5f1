"""Contents of a recorded trace: topics with messages, their types, and the names of the values in them."""

from mcap.reader import make_reader

from flexneedle.record.messages import STORE


def contents(folder):
    """Type and names of values of each topic of a run that has messages."""
    found = {}
    with (folder / "trace.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            _, names = found.setdefault(channel.topic, (schema.name, set()))
            names |= set(_names(STORE.deserialize_cdr(message.data, schema.name)))
    return found


def _names(message):
    """Names of joints, or of a status and its values; fields of another message."""
    if hasattr(message, "name"):
        return message.name
    if hasattr(message, "status"):
        return [name for one in message.status for name in (one.name, *(pair.key for pair in one.values))]
    return vars(message)
