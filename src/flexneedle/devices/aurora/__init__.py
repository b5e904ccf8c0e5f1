"""NDI Aurora over a serial line, read by ndicapi in a process of its own."""

from .tracker import Aurora

__all__ = ["Aurora"]
