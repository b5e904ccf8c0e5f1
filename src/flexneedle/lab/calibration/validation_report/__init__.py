"""Report on a validation: figures and an HTML page."""
