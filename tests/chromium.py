"""Debian's Chromium, for tests and measurements of the page."""

import shutil

CHROMIUM = shutil.which("chromium")
# WebGL in software, the rest of the page without a GPU that is emulated: that would take most of a core.
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
NO_WEBGL = """{
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    return kind.startsWith("webgl") ? null : context.call(this, kind, ...more);
  };
}"""
"""A script that runs first and leaves the page without WebGL."""
