"""Debian's Chromium, for tests and measurements of the page."""

import shutil

CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-accelerated-2d-canvas", "--disable-gpu-rasterization",
]  # fmt: skip
