"""Vendored modules have their hashes, and the page needs nothing that a strict policy refuses."""

import hashlib
import re
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("path", sorted(STATIC.rglob("*.js")), ids=lambda path: path.name)
def test_a_module_imports_only_modules_beside_it(path):
    for imported in IMPORT.findall(path.read_text()):
        assert imported.startswith("."), imported
        assert "${" in imported or (path.parent / imported).is_file(), imported


def test_html_has_no_script_style_or_address_of_its_own():
    html = (STATIC / "index.html").read_text()
    assert not re.search(r"<style|\sstyle=|\son\w+=|https?:", html)
    assert all("src=" in tag for tag in re.findall(r"<script[^>]*>", html))


def test_no_script_or_style_names_another_host():
    own = [
        path for path in STATIC.rglob("*") if path.suffix in (".js", ".css") and VENDOR not in path.parents
    ]
    assert {path.parent.name for path in own} > {"static", "flat", "form", "space"}
    for path in own:
        assert not re.search(r"https?://(?!www\.w3\.org/)", path.read_text()), path.name
