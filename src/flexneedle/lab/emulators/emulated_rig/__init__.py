"""A whole emulated rig in three processes: motors move the true needle, and the tracker measures its tip."""
