"""The report of a study: its page and figures."""
