"""Layers of tissue: a law of radial compression is a file here, or of your own."""
