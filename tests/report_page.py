"""The page of a report, parsed."""

from dataclasses import dataclass, field
from html.parser import HTMLParser


def save_nothing(_figure, folder, name):
    """Save a figure as two empty files, and return their paths."""
    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    for path in paths:
        path.touch()
    return paths


@dataclass
class Table:
    """The headings of a table, and the labels of the cells of each row of its body."""

    headings: list[str] = field(default_factory=list)
    labels: list[list[str]] = field(default_factory=list)


class Page(HTMLParser):
    """A parsed page: tags with attributes, the text outside of style, and tables by caption."""

    def __init__(self, path):
        super().__init__()
        self.tags, self.open, self.words, self.tables = [], [], [], {}
        self.feed(path.read_text(encoding="utf-8"))
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "tr" and "tbody" in self.open:
            self._table.labels.append([])
        elif tag in ("td", "th") and "tbody" in self.open:
            self._table.labels[-1].append(dict(attrs)["data-label"])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)
        if self.open[-2:] == ["caption", "span"]:
            self._table = self.tables.setdefault(data, Table())
        elif self.open[-1:] == ["th"] and "thead" in self.open:
            self._table.headings.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())
