"""The check of words finds each banned construction, at its line, and nothing in plain sentences."""

import subprocess
import sys

import pytest

import words

# A sentence for each alternative of each pattern of SENTENCES.
BANNED = {
    "that of": ["The error is that of the tracker.", "Units are those of\nthe file."],
    "that which": ["It returns that which was planned.", "Keep those which fit."],
    "what comes of": ["What comes of a job.", "See what becomes of it.", "what became of the plan"],
    "is to be": ["The key that is to be sent.", "Rows were to be kept."],
    "of its own": ["A process of its own.", "Files of their own.", "A room of one's own."],
    "lets be": ["It lets be what is old.", "Let it be."],
    "as it was meant": ["The value as it was meant.", "Keys as they are meant."],
    "told": ["The controller is not told.", "The log tells why."],
    "said": ["The header says so.", "As was said above."],
    "learnt": ["The stiffness is learnt."],
    "believed": ["It is believed.", "The belief is updated.", "It believes the reading."],
    "sees": ["The tracker sees the tip."],
    "looks": ["It looks for a file.", "It looked right."],
    "stands": ["The limit stands twice."],
    "lies": ["The tip lies below."],
    "goes on": ["The insertion goes on.", "Press Go on.", "It went on.", "Steps going on."],
    "in turn": ["Each axis in turn."],
    "aside": ["The target is 4 mm aside."],
    "lateral place": ["Its lateral place.", "lateral\nplaces"],
    "so long": ["It takes so long.", "The best plan so far.", "It ends so soon."],
    "that many": ["At most that many rows.", "So many messages.", "So much time."],
}
PLAIN = [
    "Return the lateral offset of the tip (mm).",
    "The values of the file replace the values of the preset; that is a rule of all sections.",
    "Repeat so long as the search improves, as many times as needed; so far as known.",
    "A belay, a standstill, an outlook, a turn of the base and the lies2 key.",
    "The file must be closed before the insertion continues.",
]


@pytest.mark.parametrize("sentence", PLAIN)
def test_a_plain_sentence_passes(sentence):
    assert list(words.findings((1, "function", sentence))) == []


@pytest.mark.parametrize(("name", "remedy"), [(name, remedy) for name, _, remedy in words.SENTENCES])
def test_a_banned_construction_is_found_in_every_form(name, remedy):
    for sentence in BANNED[name]:
        assert [(found, write) for _, found, _, write in words.findings((1, "prose", sentence))] == [
            (name, remedy)
        ]


def test_every_example_has_its_pattern():
    assert {name for name, _, _ in words.SENTENCES} == set(BANNED)


@pytest.mark.parametrize(
    ("docstring", "name"),
    [
        *(
            (f"{word} it has found.", "What …")
            for word in ("What", "How", "Who", "Whose", "Which", "Where", "When")
        ),
        ("Whether it has ended.", "Whether …"),
        ("As the one of a plan.", "As that of"),
    ],
)
def test_an_odd_opening_of_a_docstring_is_found(docstring, name):
    assert [found for _, found, _, _ in words.findings((1, "function", docstring))] == [name]
    assert list(words.findings((1, "message", docstring))) == []


def test_a_property_or_an_attribute_may_be_whether_something_holds():
    (text,) = words.python('class A:\n    @property\n    def done(self):\n        "Whether it has ended."\n')
    assert list(words.findings(text)) == []
    (text,) = words.python('class A:\n    done: bool\n    "Whether it has ended."\n')
    assert list(words.findings(text)) == []
    (text,) = words.python('class A:\n    def done(self):\n        "Whether it has ended."\n')
    assert len(list(words.findings(text))) == 1


def found_in(tmp_path, name: str, source: str) -> list[tuple[int, str]]:
    """The lines and constructions of a file."""
    (tmp_path / name).write_text(source, encoding="utf-8")
    found = [each for _, text in words.texts([tmp_path]) for each in words.findings(text)]
    return sorted((line, construction) for line, construction, _, _ in found)


def test_docstrings_comments_and_messages_of_python_are_read_and_names_are_not(tmp_path):
    source = (
        '"""A module.\n\nIt is that of a plan."""\n'
        'aside = {"aside": f"{aside} lies at {aside}"}  # that of\n'
        'raise ValueError(f"{aside} mm " "goes on")\n'
    )
    assert found_in(tmp_path, "a.py", source) == [
        (3, "that of"),
        (4, "lies"),
        (4, "that of"),
        (5, "goes on"),
    ]


def test_prose_of_markdown_is_read_and_code_is_not(tmp_path):
    source = "# Title\n\nIt is that\nof a plan, `that of`, [in turn](aside).\n\n```sh\nin turn\n```\n\n    in turn\n"
    assert found_in(tmp_path, "a.md", source) == [(3, "that of"), (4, "in turn")]


def test_messages_of_scripts_are_read_and_comments_are_not(tmp_path):
    source = "// that of\nconst aside = 'aside';\nsay(`${aside} lies\n there, and that of`, \"in turn\");\n"
    assert found_in(tmp_path, "a.js", source) == [(3, "lies"), (4, "in turn"), (4, "that of")]


def test_vendored_files_are_not_read(tmp_path):
    (tmp_path / "vendor").mkdir()
    (tmp_path / "vendor" / "a.md").write_text("that of", encoding="utf-8")
    assert list(words.texts([tmp_path])) == []


def test_the_command_prints_findings_and_counts(tmp_path):
    (tmp_path / "a.md").write_text("One two\nthat of three\n", encoding="utf-8")
    line = [sys.executable, words.__file__, str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, f"{tmp_path / 'a.md'}:2: 'that of': write repeat the noun\n")
    counts = subprocess.run([*line, "--count"], capture_output=True, text=True)
    assert counts.returncode == 0
    assert [row.split() for row in counts.stdout.splitlines()] == [
        ["1", "200.00", "that", "of"],
        ["1", "200.00", "all,", "in", "5", "words"],
    ]


def test_the_checked_parts_exist():
    assert [path for path in words.CHECKED if not (words.ROOT / path).exists()] == []
