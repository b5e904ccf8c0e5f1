"""Report constructions that the house style bans, in docs, docstrings, comments, messages and the page's scripts.

python tools/lint/words.py              # check docs and code; exit status 1 for a finding
python tools/lint/words.py src docs     # check other files and folders
python tools/lint/words.py --count src  # count the findings of each construction, also per 1,000 words
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CHECKED = ("README.md", "docs", "src", "tests", "campaigns", "studies", "benchmarks", "tools")
# Construction, pattern (a space matches any white space), what to write.
SENTENCES = (
    ("that of", r"(that|those) of", "repeat the noun"),
    ("that which", r"(that|those) which", "name the thing"),
    ("what comes of", r"what (comes|came|becomes|became|will become) of", "name the result"),
    ("is to be", r"(is|are|was|were) to be", "must be, or an imperative"),
    ("of its own", r"of (one's|its|his|their) own", "own, separate or custom before the noun"),
    ("lets be", r"lets? (be|it be|them be)", "leaves unchanged, or ignores"),
    ("as it was meant", r"as (it|they) (is|are|was|were) meant", "as intended, or the intended value"),
    ("told", r"tells|told", "reports, prints, or a passive"),
    ("said", r"says|said", "reports, prints, states"),
    ("learnt", r"learnt", "estimated"),
    ("believed", r"believe[sd]?|beliefs?", "estimate, prior, posterior"),
    ("sees", r"sees", "measures, checks, receives"),
    ("looks", r"looks|looked", "checks, searches, resembles"),
    ("stands", r"stands", "is"),
    ("lies", r"lies", "is"),
    ("goes on", r"go(es)? on|went on|going on", "continues"),
    ("in turn", r"in turn", "alternately, one after another"),
    ("aside", r"aside", "lateral, lateral offset"),
    ("lateral place", r"lateral places?", "lateral offset"),
    ("so long", r"so (long|far|soon)(?! as)", "the value with its unit, until now, early"),
    ("that many", r"(that|so) (many|much)(?! as)", "the number"),
)
OPENINGS = (
    ("What …", r"(What|How|Who|Whom|Whose|Which|Where|When|Why)\b", "a verb, or a noun phrase"),
    ("Whether …", r"Whether\b", '"Return whether …"'),
    ("As that of", r"As (that|those|the one|the ones) of\b", "what the function does"),
)
_SENTENCES = [
    (name, re.compile(rf"\b(?:{pattern})\b".replace(" ", r"\s+"), re.IGNORECASE), remedy)
    for name, pattern, remedy in SENTENCES
]
_OPENINGS = [(name, re.compile(rf"\s*{pattern}"), remedy) for name, pattern, remedy in OPENINGS]

_CODE = re.compile(r"^```.*?^```|^ {4}\S[^\n]*|`[^`\n]+`|\]\([^)\n]*\)|<!--.*?-->", re.MULTILINE | re.DOTALL)
_SCRIPT = re.compile(r"//[^\n]*|/\*.*?\*/|\"[^\"\n]*\"|'[^'\n]*'|`[^`]*`", re.DOTALL)

# A text: its first line in the file, what it is, the text.
Text = tuple[int, str, str]


def markdown(source: str) -> Iterator[Text]:
    """Yield the prose of a Markdown page: code and targets of links are blank."""
    yield 1, "prose", _CODE.sub(lambda found: re.sub(r"[^\n]", "·", found[0]), source)


def python(source: str) -> Iterator[Text]:
    """Yield docstrings of modules, classes, functions and attributes, strings with a space, and comments."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], "comment", re.sub(r"`[^`\n]+`", "·", token.string)
    waiting: list[tuple[ast.AST, str]] = [(ast.parse(source), "module")]
    while waiting:
        node, kind = waiting.pop()
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Constant | ast.JoinedStr):
                docstring = isinstance(node, ast.Expr)
                text = _string(child)
                if docstring or " " in text:
                    yield child.lineno, kind if docstring else "message", re.sub(r"`[^`\n]+`", "·", text)
            else:
                waiting.append((child, kind if isinstance(child, ast.Expr) else _kind(child, kind)))


def _string(node: ast.Constant | ast.JoinedStr) -> str:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    return "".join(_string(part) if isinstance(part, ast.Constant) else "…" for part in node.values)


def _kind(node: ast.AST, outer: str) -> str:
    """Return "function" or "attribute", by whose docstring a string in the node is."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        names = [getattr(each, "id", getattr(each, "attr", "")) for each in node.decorator_list]
        return "attribute" if any("property" in name for name in names) else "function"
    return "attribute" if isinstance(node, ast.ClassDef) else outer


def javascript(source: str) -> Iterator[Text]:
    """Yield the strings with a space of a script."""
    for found in _SCRIPT.finditer(source):
        if found[0][0] != "/" and " " in found[0]:
            yield source.count("\n", 0, found.start()) + 1, "message", re.sub(r"\$\{[^}]*\}", "…", found[0])


READERS = {".md": markdown, ".py": python, ".js": javascript}


def texts(paths: list[Path]) -> Iterator[tuple[Path, Text]]:
    """Yield the texts of files and of all files in folders, except vendored ones, this check and its tests.

    Strings of tests are data, not messages.
    """
    for path in paths:
        for file in [path] if path.is_file() else sorted(path.rglob("*")):
            if (
                file.suffix not in READERS
                or "vendor" in file.parts
                or file.name in ("words.py", "test_words.py")
            ):
                continue
            for text in READERS[file.suffix](file.read_text(encoding="utf-8")):
                if text[1] != "message" or not file.is_relative_to(ROOT / "tests"):
                    yield file, text


def findings(text: Text) -> Iterator[tuple[int, str, str, str]]:
    """Yield the line, the construction, the words found and the remedy."""
    line, kind, words = text
    for name, pattern, remedy in [] if kind in ("prose", "message", "comment") else _OPENINGS:
        # "Whether the plan ends within 1 mm of the target." is a good docstring of a property.
        if (found := pattern.match(words)) and not (kind == "attribute" and name.startswith("Whether")):
            yield line, name, found[0].strip(), remedy
    for name, pattern, remedy in _SENTENCES:
        for found in pattern.finditer(words):
            yield line + words.count("\n", 0, found.start()), name, " ".join(found[0].split()), remedy


def main() -> int:
    """Print the findings or their counts; return 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, default=[ROOT / path for path in CHECKED])
    parser.add_argument("--count", action="store_true", help="count each construction")
    options = parser.parse_args()
    read = list(texts(options.paths))
    found = sorted((file, *each) for file, text in read for each in findings(text))
    if options.count:
        words = sum(len(text.split()) for _, (_, _, text) in read)
        for name, count in Counter(each[2] for each in found).most_common():
            print(f"{count:6} {1000 * count / words:6.2f}  {name}")
        print(f"{len(found):6} {1000 * len(found) / words:6.2f}  all, in {words} words")
        return 0
    for file, line, _, banned, remedy in found:
        print(f"{file}:{line}: {banned!r}: write {remedy}")
    return min(len(found), 1)


if __name__ == "__main__":
    sys.exit(main())
