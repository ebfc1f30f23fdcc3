"""A Markdown text as one self-contained HTML page: pictures inside, nothing fetched, readable on a phone."""

from __future__ import annotations

import base64
import html
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any
from xml.etree.ElementTree import Element

import markdown
from markdown.extensions import Extension
from markdown.treeprocessors import Treeprocessor

HEADINGS = ("h1", "h2", "h3", "h4")


def as_page(text: str, title: str, folder: Path, marks: tuple[str, ...] = ()) -> str:
    """HTML of a Markdown text.

    Args:
        text: Markdown with tables; its pictures are PNG files, HTML in it is shown as text.
        title: of the page.
        folder: pictures' paths begin here.
        marks: words that give a table's cell their own class, spaces as hyphens, such as verdicts.
    Raises:
        FileNotFoundError: a picture is missing.
    """
    return shell(title, fragment(text, folder, marks))


def fragment(text: str, folder: Path = Path(), marks: tuple[str, ...] = (), name: str = "") -> str:
    """What stands between a page's head and foot; arguments as of `as_page`, and a name for what has no heading."""
    extensions = ["tables", "toc", _SelfContained(folder, marks, name)]
    return markdown.markdown(text, extensions=extensions, output_format="html")


def shell(title: str, body: str) -> str:
    """The page around a body of HTML."""
    page = Template((resources.files("agents") / "page.html").read_text(encoding="utf-8"))
    return page.substitute(title=html.escape(title), body=body)


class _SelfContained(Extension):
    """Adds `_Insides` to the conversion."""

    def __init__(self, folder: Path, marks: tuple[str, ...], name: str):
        super().__init__()
        self._settings = folder, marks, name

    def extendMarkdown(self, md: markdown.Markdown) -> None:
        """Called by the library. HTML in the text stays text; the tree changes after its inline parts (20) are made."""
        md.preprocessors.deregister("html_block")
        md.inlinePatterns.deregister("html")
        md.treeprocessors.register(_Insides(md, *self._settings), "insides", 3)


class _Insides(Treeprocessor):
    """Pictures as data, headers with scope, tables in named regions that scroll by touch and by keyboard."""

    def __init__(self, md: markdown.Markdown, folder: Path, marks: tuple[str, ...], name: str):
        super().__init__(md)
        self._folder, self._marks, self._name = folder, marks, name

    def run(self, root: Element) -> None:
        """Change the tree in place."""
        for picture in root.iter("img"):
            content = (self._folder / picture.attrib["src"]).read_bytes()
            picture.set("src", "data:image/png;base64," + base64.b64encode(content).decode())
        for head in root.iter("th"):
            head.set("scope", "col")
        for cell in root.iter("td"):
            if cell.text in self._marks:
                cell.set("class", cell.text.replace(" ", "-"))
        self._frame_tables(root)

    def _frame_tables(self, root: Element) -> None:
        """Tables stand at the top level; each region bears the heading above it."""
        name = self._name
        for i, block in enumerate(list(root)):
            if block.tag in HEADINGS:
                name = "".join(block.itertext())
            elif block.tag == "table":
                frame: Any = Element("div", {"class": "table", "role": "region", "tabindex": "0", "aria-label": name})
                frame.append(block)
                root[i] = frame
