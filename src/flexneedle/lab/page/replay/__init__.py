"""A run as one HTML file that replays it by itself."""
