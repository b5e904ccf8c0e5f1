"""The closed loop of an insertion: ports, monitor, guard and periods."""
