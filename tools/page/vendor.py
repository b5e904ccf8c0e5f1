"""Make static/vendor of the page: a minified subset of three.js, and uPlot, each one module without bare imports.

Run by hand when a version changes, with npm: python tools/page/vendor.py. The result is committed.
"""

import argparse
import hashlib
import json
import subprocess
import tempfile
from pathlib import Path

VENDOR = Path(__file__).parents[2] / "src/flexneedle/lab/page/static/vendor"

PACKAGES = {  # version, and integrity as the registry publishes it
    "three": (
        "0.187.0",
        "sha512-Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
    ),
    "uplot": (
        "1.6.32",
        "sha512-KIMVnG68zvu5XXUbC4LQEPnhwOxBuLyW1AHtpm6IKTXImkbLgkMy+jabjLgSLMasNuGGzQm/ep3tOkyTxpiQIw==",
    ),
    "esbuild": (
        "0.28.2",
        "sha512-HKVLS8dvII+xoKW9kmqxbRKrnWEXfJJr/FZhhJmiqIB0e053QNYFqOBouTMO/k5sID4MvCiUCvv8b9M4h32wIA==",
    ),
}

THREE = """
export {
  AmbientLight, BackSide, BoxGeometry, BufferAttribute, BufferGeometry, CanvasTexture, Color,
  ConeGeometry, CylinderGeometry, DirectionalLight, DoubleSide, DynamicDrawUsage, EdgesGeometry, Group,
  LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera,
  PlaneGeometry, SRGBColorSpace, Scene, SphereGeometry, Sprite, SpriteMaterial, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { TransformControls } from "three/addons/controls/TransformControls.js";
"""
UPLOT = 'export { default } from "uplot";\n'


def installed(folder: Path) -> Path:
    """node_modules of the pinned packages. Raises SystemExit if the registry's integrity is not the pinned one."""
    wanted = [f"{name}@{version}" for name, (version, _) in PACKAGES.items()]
    (folder / "package.json").write_text("{}")
    subprocess.run(
        ["npm", "install", "--ignore-scripts", "--no-audit", "--silent", *wanted], cwd=folder, check=True
    )
    locked = json.loads((folder / "package-lock.json").read_text())["packages"]
    for name, (version, integrity) in PACKAGES.items():
        found = locked[f"node_modules/{name}"]["integrity"]
        if found != integrity:
            raise SystemExit(f"{name} {version}: integrity {found}: must be {integrity}")
    return folder / "node_modules"


def bundled(modules: Path, entry: str, banner: str) -> bytes:
    """One minified module with everything that `entry` imports."""
    command = [modules / ".bin/esbuild", "--bundle", "--minify", "--format=esm", "--target=es2022"]
    command += ["--legal-comments=none", f"--banner:js=/* {banner} */"]
    return subprocess.run(
        command, cwd=modules.parent, input=entry.encode(), stdout=subprocess.PIPE, check=True
    ).stdout


def made(modules: Path) -> dict[str, bytes]:
    """Files of the folder by name."""
    three, uplot = (f"{name} {PACKAGES[name][0]}, MIT, see {name}.LICENSE" for name in ("three", "uplot"))
    files = {
        "three.js": bundled(modules, THREE, f"A subset of {three}"),
        "uplot.js": bundled(modules, UPLOT, uplot),
        "uplot.css": (modules / "uplot/dist/uPlot.min.css").read_bytes(),
        "three.LICENSE": (modules / "three/LICENSE").read_bytes(),
        "uplot.LICENSE": (modules / "uplot/LICENSE").read_bytes(),
    }
    hashes = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(files.items()))
    return files | {"SHA256SUMS": hashes.encode()}


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = made(installed(Path(folder)))
    VENDOR.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (VENDOR / name).write_bytes(data)


if __name__ == "__main__":
    main()
