"""Connection of an insertion to other programs, whatever the protocol: its node's process, stops, targets, states."""
