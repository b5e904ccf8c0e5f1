"""Frames and keys: Python and JavaScript agree."""

import re
from pathlib import Path

import numpy as np
import pytest

import flexneedle.lab.page
from flexneedle.lab.page.shape_frames import FrameKind, FrameSource, make_frame, pack_frame
from page_clients import BY

STATIC = Path(flexneedle.lab.page.__file__).parent / "static"
READ = """async (frames) => {
  const { unpacked } = await import("/static/frames.js");
  return frames.map((bytes) => {
    try {
      const frame = unpacked(new Uint8Array(bytes).buffer);
      return { ...frame, values: [...frame.values] };
    } catch (error) {
      return error.message;
    }
  });
}"""


def table_of(module, name):
    """Return a table of a module in JavaScript."""
    found = re.search(rf"const {name} = [^{{]*{{(.*?)}}", (STATIC / module).read_text(), re.DOTALL)
    return dict(re.findall(r'(\w+): "?(\w+)', found[1]))


def test_both_languages_have_the_same_kinds_sources_and_keys():
    for name, numbers in (("Kind", FrameKind), ("Source", FrameSource)):
        assert table_of("frames.js", name) == {
            key: str(int(value)) for key, value in numbers.__members__.items()
        }
    assert table_of("store.js", "BY") == {type_: by for type_, by in BY.items() if by}


@pytest.mark.page
def test_a_browser_reads_what_python_packs_and_refuses_other_bytes(visit):
    values = np.arange(24, dtype=np.float32).reshape(2, 3, 4) / 7
    good = pack_frame(make_frame(FrameKind.SAMPLES, FrameSource.STEERING, 3_000_000_000, *values))
    other_kind, other_source = b"\x63" + good[1:], good[:2] + b"\x63" + good[3:]
    bad = [good[:15], good[:-1], good + b"\0", good[:3] + b"\1" + good[4:], other_kind, other_source]
    read, *refused = visit().evaluate(READ, [list(frame) for frame in (good, *bad)])
    named = (FrameKind.SAMPLES, FrameSource.STEERING, 3_000_000_000, *values.shape)
    assert tuple(read[key] for key in ("kind", "source", "number", "paths", "points", "columns")) == named
    np.testing.assert_array_equal(np.float32(read["values"]), values.ravel())
    assert all(isinstance(each, str) for each in refused)
