"""Debian's Chromium, for tests and measurements of the page."""

import shutil

CHROMIUM = shutil.which("chromium")
ARGUMENTS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-accelerated-2d-canvas", "--disable-gpu-rasterization",
]  # fmt: skip
NO_WEBGL = """{
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    return kind.startsWith("webgl") ? null : context.call(this, kind, ...more);
  };
}"""
"""A script before those of a page, which then has no WebGL."""
