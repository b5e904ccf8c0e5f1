"""Vendored modules have their hashes, and the page needs nothing that a strict policy refuses."""

import hashlib
import re
from pathlib import Path

import flexneedle.lab.page

STATIC = Path(flexneedle.lab.page.__file__).parent / "static"
VENDOR = STATIC / "vendor"
IMPORT = re.compile(r"""(?:\bfrom\s*["']|\bimport\s*\(?\s*["'`])([\w@./][^"'`]*)""")


def test_each_vendored_file_has_its_hash():
    lines = [line.split("  ") for line in (VENDOR / "SHA256SUMS").read_text().splitlines()]
    hashes = {name: digest for digest, name in lines}
    assert set(hashes) | {"SHA256SUMS"} == {path.name for path in VENDOR.iterdir()}
    for name, digest in hashes.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == digest, name


def test_scripts_styles_and_html_need_only_files_of_the_page():
    """Modules import modules beside them; the page has no inline script or style, and names no other host."""
    html = (STATIC / "index.html").read_text()
    assert not re.search(r"<style|\sstyle=|\son\w+=|https?:", html)
    assert all("src=" in tag for tag in re.findall(r"<script[^>]*>", html))
    for path in STATIC.rglob("*.js"):
        for imported in IMPORT.findall(path.read_text()):
            assert imported.startswith("."), imported
            assert "${" in imported or (path.parent / imported).is_file(), imported
    for path in (*STATIC.rglob("*.js"), *STATIC.rglob("*.css")):
        if VENDOR not in path.parents:
            assert not re.search(r"https?://(?!www\.w3\.org/)", path.read_text()), path.name
