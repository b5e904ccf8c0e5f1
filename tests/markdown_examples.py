"""The examples of a Markdown page: its fenced blocks, run in order in one folder, and the outputs that it shows.

Python executes a block of `python`, the shell a block of `sh` or `bash`; a block of `text` that follows directly is
its output. `title="NAME"` makes a block a file of this name instead. A comment `<!-- no-run: REASON -->` in the
line above a block keeps it from being run, and `<!-- run: COMMAND -->` runs a command that the page does not show.
A line `--8<-- "NAME"` is replaced by the file docs/examples/NAME, as on the site.

    python tests/markdown_examples.py docs/tutorial.md      # writes the outputs that its examples print into the page
"""

import contextlib
import io
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "decisions" not in p.parts)]
EXAMPLES = ROOT / "docs" / "examples"
SHELL = ("sh", "bash")

_BLOCK = re.compile(
    r"(?:^<!-- no-run: (?P<reason>[^\n]+) -->\n)?^```(?P<language>\w*)(?P<info>[^\n]*)\n(?P<code>.*?)^```$"
    r"|^<!-- run: (?P<command>[^\n]+) -->$",
    re.MULTILINE | re.DOTALL,
)
_INCLUDED = re.compile(r'^--8<-- "(.+)"\n', re.MULTILINE)
_TITLE = re.compile(r'title="([^"]+)"')
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_RELATIVE, _ABSOLUTE = 0.01, 0.002


@dataclass(frozen=True)
class Block:
    """A fenced block: language, code, file name or "", reason for not running it or "", and its output or None.

    span: of the output in the page; line: of the block.
    """

    language: str
    code: str
    line: int
    title: str = ""
    skipped: str = ""
    output: str | None = None
    span: tuple[int, int] = (0, 0)

    @property
    def runs(self) -> bool:
        """Whether the block is executed."""
        return not self.title and not self.skipped and self.language in ("python", *SHELL)


def blocks(page: str) -> list[Block]:
    """Return the blocks of a page, each with the output that follows it."""
    found = list(_BLOCK.finditer(page))
    result = []
    for match, after in zip_longest(found, found[1:]):
        line = page.count("\n", 0, match.start()) + 1
        if match["command"]:
            result.append(Block("sh", match["command"] + "\n", line))
            continue
        title = _TITLE.search(match["info"])
        code = _INCLUDED.sub(lambda found: (EXAMPLES / found[1]).read_text(encoding="utf-8"), match["code"])
        block = Block(match["language"], code, line, title[1] if title else "", match["reason"] or "")
        if after and after["language"] == "text" and not page[match.end() : after.start()].strip():
            block = replace(block, output=after["code"], span=after.span("code"))
        result.append(block)
    return result


def printed(page: list[Block], folder: Path) -> Iterator[tuple[Block, str]]:
    """Run the blocks of a page in the current folder; yield each with its output."""
    names: dict[str, object] = {"__name__": "example"}
    for block in page:
        if block.title:
            (folder / block.title).write_text(block.code, encoding="utf-8")
    for block in page:
        if block.runs:
            yield block, _python(block, names) if block.language == "python" else _shell(block, folder)


def _python(block: Block, names: dict[str, object]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile("\n" * block.line + block.code, "page", "exec"), names)
    return out.getvalue()


def _shell(block: Block, folder: Path) -> str:
    paths = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": paths, "COLUMNS": "100"}
    line = ["bash", "-euo", "pipefail", "-c", block.code]
    done = subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"line {block.line}: exit status {done.returncode}\n{block.code}{done.stderr}")
    return done.stdout


def same(shown: str, real: str) -> str:
    """Return "" if a page shows the output of an example, else the first line that differs.

    `…` in a line matches any text, `…` alone any lines. Numbers may differ by 1 % or by 0.002, because
    the last digits differ between processors.
    """
    wanted, got = (text.rstrip("\n").splitlines() for text in (shown, real))
    return _difference([line.rstrip() for line in wanted], [line.rstrip() for line in got])


def _difference(wanted: list[str], got: list[str]) -> str:
    for number, line in enumerate(wanted):
        if line.strip() == "…":
            rest = [_difference(wanted[number + 1 :], got[k:]) for k in range(number, len(got) + 1)]
            return "" if "" in rest else rest[-1]
        if number == len(got) or not _same_line(line, got[number]):
            return f"shown: {line}\nreal:  {got[number] if number < len(got) else '(nothing)'}"
    return "" if len(wanted) == len(got) else f"not shown: {got[len(wanted)]}"


def _same_line(shown: str, real: str) -> bool:
    pattern = _NUMBER.sub("\0", shown)
    parts = [_literal(part) for part in pattern.split("…")]
    found = re.fullmatch(".*".join(parts), real)
    numbers = [float(number) for number in _NUMBER.findall(shown)]
    return found is not None and all(
        math.isclose(float(value), number, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)
        for value, number in zip(found.groups(), numbers, strict=True)
    )


def _literal(text: str) -> str:
    return re.sub(" +", " +", re.escape(text).replace(r"\ ", " ")).replace(
        re.escape("\0"), f"({_NUMBER.pattern})"
    )


def rewritten(page: str, folder: Path) -> str:
    """Return the page with real outputs where they differ."""
    changes = [
        (block.span, _merged(block.output, real))
        for block, real in printed(blocks(page), folder)
        if block.output is not None and same(block.output, real)
    ]
    for (start, end), real in reversed(changes):
        page = page[:start] + real + page[end:]
    return page


def _merged(shown: str, real: str) -> str:
    """Return the real output, with the lines of the page, `…` included, that agree with it."""
    old, new = shown.splitlines(), [line.rstrip() for line in real.rstrip("\n").splitlines()]
    pairs = zip(old, new, strict=True) if len(old) == len(new) else (("", line) for line in new)
    return "".join(f"{kept if _same_line(kept, line) else line}\n" for kept, line in pairs)


def main() -> None:
    """Write the real outputs into the pages of the command line."""
    sys.path.insert(0, "")
    for path in map(Path.absolute, map(Path, sys.argv[1:])):
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            path.write_text(rewritten(path.read_text(encoding="utf-8"), Path(folder)), encoding="utf-8")


if __name__ == "__main__":
    main()
