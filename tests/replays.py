"""Replays of invented insertions, and the contents of their files."""

import json
from base64 import b64decode
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser

from flexneedle.lab.page.worker.recordings import describe_recording
from flexneedle.scenario.files import load_scenario
from synthetic import make_insertion, make_plan


def insertion(seed=0, **options):
    """An insertion of 69 periods with its scenario."""
    plan = replace(make_plan(seed=seed), scenario=load_scenario("phantom"))
    return make_insertion(plan, seed=seed, **options)


def record(made=None, name="mine", of="first", lacking=""):
    """Return the reports of a worker about an insertion."""
    return list(describe_recording(made or insertion(), name, of, lacking))


@dataclass
class File(HTMLParser):
    """The elements of an HTML file: of each its attributes, and its text up to the next tag."""

    elements: list = field(default_factory=list)
    inside: bool = False

    def __post_init__(self):
        super().__init__()

    @classmethod
    def of(cls, text):
        file = cls()
        file.feed(text)
        file.close()
        return file

    def handle_starttag(self, tag, attrs):
        self.elements.append([tag, dict(attrs), ""])
        self.inside = True

    def handle_endtag(self, _tag):
        self.inside = False

    def handle_data(self, data):
        if self.inside:
            self.elements[-1][2] += data

    def all(self, tag, **attributes):
        """Text of each element of a name with these attributes."""
        return [
            text for name, given, text in self.elements if name == tag and attributes.items() <= given.items()
        ]

    @property
    def script(self):
        return self.all("script", type="module")[0]

    @property
    def policy(self):
        (policy,) = (given["content"] for _, given, _ in self.elements if "http-equiv" in given)
        return policy

    @property
    def record(self):
        """News as JSON, and bytes of frames."""
        (data,) = self.all("script", id="run")
        return [b64decode(each) if isinstance(each, str) else each for each in json.loads(data)]
