"""A run as one HTML file: complete, with its record, and without loading or executing anything else."""

import hashlib
import json
import re
import subprocess
import sys
from base64 import b64encode
from dataclasses import replace
from pathlib import Path

import pytest

import flexneedle.lab.page
from flexneedle.lab.page import replay
from flexneedle.lab.page.replay import bundle_modules, encode_record, make_document
from flexneedle.lab.page.shape_frames import FrameSource, ShapeFrame, pack_frame
from flexneedle.record.fields import page_values
from flexneedle.types import Pose
from page_frames import unpack_frame
from replays import File, insertion, record
from synthetic import blind

STATIC = Path(flexneedle.lab.page.__file__).parent / "static"
IMPORT = re.compile(r"""\b(?:from\s*|import\s*\(?\s*)["']([./][^"']+)["']""")
HOSTILE = "</script><script>alert(1)</script><!-- <script> \u2028 & \" ' $run \\u003c é"


@pytest.fixture(scope="module")
def text():
    return make_document("mine", record())


@pytest.fixture(scope="module")
def file(text):
    return File.of(text)


def as_sent(record):
    """Return the messages and frames as the page gets them from its server."""
    return [
        pack_frame(one) if isinstance(one, ShapeFrame) else json.loads(one.model_dump_json())
        for one in record
    ]


def kinds(record):
    return [one.kind.name if isinstance(one, ShapeFrame) else one.type for one in record]


def test_the_record_is_equal_to_the_reports_of_a_worker(file):
    made = insertion()
    assert file.record == as_sent(record())
    assert kinds(record()) == ["insertion", "zones", "PATH", "NEEDLE", "TRUE", "rows"]
    assert file.record[0]["load"] == made.invasiveness.rows()
    path, needles, true = (unpack_frame(each) for each in file.record if isinstance(each, bytes))
    assert {frame.source for frame in (path, needles, true)} == {FrameSource.FIRST}
    assert path.values[0] == pytest.approx(made.plan.tips[:, :3], abs=1e-4)
    assert len(file.record[-1]["rows"]) == 69
    for at in (0, 68):
        assert needles.values[at] == pytest.approx(made.periods[at].shape[:, :3], abs=1e-4)
        assert true.values[at] == pytest.approx(made.periods[at].true_shape, abs=1e-4)


def test_unknown_values_are_null_and_have_no_shapes():
    made = insertion()
    made = replace(made, periods=tuple(blind(period) for period in made.periods))
    assert kinds(record(made)) == ["insertion", "zones", "PATH", "NEEDLE", "rows"]
    *_, rows = File.of(make_document("mine", record(made))).record
    unknown = ("measured", "true", "true_energy_uj", "miss_sd_mm")
    assert {tuple(row[key] for key in unknown) for row in rows["rows"]} == {(None,) * 4}


def test_the_error_is_the_lateral_distance_from_the_planned_path_at_the_depth_of_the_tip():
    made = insertion()
    (x, y, z), period = made.plan.tips[20, :3], made.periods[30]
    tip = Pose(x, y + 3.0, z - 4.0, 0.0, 0.0)
    for changed in (replace(period, true_tip=tip), replace(period, true_tip=None, estimate=tip)):
        assert page_values(changed, made.plan)["error_mm"] == pytest.approx(5.0, abs=1e-9)


def test_a_text_of_the_record_ends_no_element():
    made = insertion(outcome="held", reason=HOSTILE)
    file = File.of(make_document(HOSTILE, record(made, name=HOSTILE)))
    assert [tag for tag, *_ in file.elements].count("script") == 2
    assert file.record[0]["name"] == HOSTILE
    assert HOSTILE in file.record[0]["summary"]
    assert file.all("p", **{"class": "title"})[0].strip() == HOSTILE
    assert "<" not in encode_record(record(made, name=HOSTILE))


def test_the_same_run_is_the_same_file(text):
    assert make_document("mine", record()) == text
    assert make_document("mine", record(insertion(seed=1))) != text


def test_nothing_is_loaded(file):
    addresses = [given.get(key) for _, given, _ in file.elements for key in ("src", "href", "data", "srcset")]
    assert [address[:5] for address in addresses if address] == ["data:", "#main"]
    (style,) = file.all("style")
    assert not re.search(r"url\(|@import", style)
    assert not re.search(r"https?://(?!www\.w3\.org/)", style + file.script)
    rules = dict(rule.split(" ", 1) for rule in file.policy.split("; "))
    assert (rules["default-src"], rules["img-src"]) == ("'none'", "data:")
    assert set(rules) == {"default-src", "script-src", "style-src", "img-src", "base-uri", "form-action"}


def test_the_policy_allows_this_script_and_this_style_alone(file):
    for rule, text in (("script-src", file.script), ("style-src", file.all("style")[0])):
        digest = b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{rule} 'sha256-{digest}'; " in file.policy


def reachable(name):
    """Modules that a module imports, and those that these import."""
    found, waiting = set(), [STATIC / name]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += [(path.parent / each).resolve() for each in IMPORT.findall(path.read_text())]
    return {path.relative_to(STATIC).as_posix() for path in found}


def test_every_module_that_the_replay_imports_is_in_it_once(file):
    names = re.findall(r'^modules\["([^"]+)"\] = ', file.script, re.MULTILINE)
    assert sorted(names) == sorted(reachable("replay.js"))
    assert {"store.js", "space/view.js", "vendor/three.js", "vendor/uplot.js"} <= set(names)
    assert names[-1] == "replay.js"
    assert "link.js" not in names
    for path in (STATIC / "vendor").glob("*.LICENSE"):
        assert path.read_text() in file.script


def test_all_modules_can_be_converted():
    """Except main.js, which imports by a computed name."""
    for path in STATIC.rglob("*.js"):
        name = path.relative_to(STATIC).as_posix()
        if name == "main.js":
            with pytest.raises(ValueError, match=r"main\.js"):
                replay._convert_module(STATIC, name)
        else:
            text = replay._convert_module(STATIC, name).text
            assert not re.search(r"^(?:import|export)\b", text, re.MULTILINE)


def bundle_of(folder, **modules):
    for name, source in modules.items():
        path = folder / f"{name}.js"
        path.write_text(source)
    return bundle_modules(folder, "entry.js")


def test_forms_of_import_and_export(tmp_path):
    (tmp_path / "vendor").mkdir()
    (tmp_path / "vendor/b.js").write_text("const x=1,y=2;export{x as default,y as z,y};\n")
    script = bundle_of(
        tmp_path,
        entry='import {\n  f, g as h,\n} from "./a.js";\nimport b from "./vendor/b.js";\nconst c = import("./c.js");\n',
        a='import { z } from "./vendor/b.js";\nexport const f = z;\nexport async function g() {}\nexport class K {}\n',
        c="const inner = 1;\n",
    )
    assert script == (
        "const modules = {};\n"
        'modules["vendor/b.js"] = (() => {\nconst x=1,y=2;\nreturn { default: x, z: y, y };\n})();\n'
        'modules["a.js"] = (() => {\nconst { z } = modules["vendor/b.js"];\nconst f = z;\nasync function g() {}\n'
        "class K {}\n\nreturn { f, g, K };\n})();\n"
        'modules["c.js"] = (() => {\nconst inner = 1;\n\nreturn {  };\n})();\n'
        'modules["entry.js"] = (() => {\nconst { f, g: h, } = modules["a.js"];\n'
        'const { default: b } = modules["vendor/b.js"];\n'
        'const c = Promise.resolve(modules["c.js"]);\n\nreturn {  };\n})();'
    )


UNKNOWN = [
    *(
        'import "./a.js";',
        'import * as a from "./a.js";',
        'import a, { b } from "./a.js";',
        "import.meta.url;",
    ),
    *("import(`./${name}.js`);", "import { a } from './a.js';", 'export { a } from "./a.js";'),
    *("export default 1;", "export let a = 1;", 'export * from "./a.js";', "export const { a } = {};"),
    "export function* a() {}",
]


def test_other_forms_and_modules_that_import_each_other_are_refused(tmp_path):
    for source in UNKNOWN:
        with pytest.raises(ValueError, match=r"^entry\.js: .* a form of import or export"):
            bundle_of(tmp_path, entry=f"{source}\n", a="export const b = 1;\n")
    with pytest.raises(ValueError, match=r"^entry\.js imports a\.js imports entry\.js: "):
        bundle_of(tmp_path, entry='import { a } from "./a.js";\n', a='import { b } from "./entry.js";\n')


@pytest.mark.parametrize("piece", ["</script>", "<SCRIPT>", "<!--", "</style>"])
def test_a_script_that_would_end_its_element_is_refused(monkeypatch, piece):
    monkeypatch.setattr(replay, "bundle_modules", lambda *_: f'"{piece}"')
    with pytest.raises(ValueError, match="it ends the element"):
        make_document("mine", [])


@pytest.mark.long
def test_it_needs_no_package_of_the_server():
    script = "import sys, flexneedle.lab.page.replay; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & {"starlette", "uvicorn", "websockets", "anyio"}
